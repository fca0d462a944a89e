"""The e-puck: the sizes, places and lookup tables of Webots' PROTO, as boxes and cylinders."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

E_PUCK: Final = """
E-puck {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFString name "e-puck"
  SFString controller "e-puck_avoid_obstacles"  MFString controllerArgs []
  SFString window "e-puck"  SFString customData ""  SFBool supervisor FALSE
  SFBool synchronization TRUE  MFFloat battery []  SFString version "1"
  SFFloat camera_fieldOfView 0.84  SFInt32 camera_width 52  SFInt32 camera_height 39
  SFBool camera_antiAliasing FALSE  SFRotation camera_rotation 0 0 1 0  SFFloat camera_noise 0
  SFFloat camera_motionBlur 0  SFInt32 distance_sensor_numberOfRays 1
  SFInt32 emitter_channel 1  SFInt32 receiver_channel 1  MFNode turretSlot []
  MFNode groundSensorsSlot []  SFBool kinematic FALSE
}
"""
"""The fields of the PROTO."""

_WHEELS: Final = (("left", 0.026), ("right", -0.026))
_EYES: Final = (  # ahead and to the left, metres; heading, radians
    *((0.03, -0.01, -0.30), (0.022, -0.025, -0.80), (0.0, -0.031, -1.571)),
    *((-0.03, -0.015, -2.64), (-0.03, 0.015, 2.64), (0.0, 0.031, 1.571)),
    *((0.022, 0.025, 0.80), (0.03, 0.01, 0.30)),
)
_PROXIMITY: Final = """0 4095 0.002 0.005 2133.33 0.003 0.01 1465.73 0.007 0.015 601.46 0.0406
    0.02 383.84 0.01472 0.03 234.93 0.0241 0.04 158.03 0.0287 0.05 120 0.04225
    0.06 104.09 0.03065 0.07 67.19 0.04897"""


def e_puck(fields: Mapping[str, Any]) -> str:
    """What an e-puck is made of, written as in a world file, from its fields."""
    is_second = fields["version"] == "2"
    max_radps, mass_kg = (7.536, 0.13) if is_second else (6.28, 0.15)
    rotation = " ".join(map(str, fields["camera_rotation"]))
    wheels = " ".join(_wheel(side, left_m, max_radps) for side, left_m in _WHEELS)
    eyes = " ".join(_eye(number, *place) for number, place in enumerate(_EYES))
    lamps = " ".join(f'LED {{ name "led{number}" }}' for number in range(10))
    return f"""Robot {{ children [ {wheels} {eyes} {lamps}
        Camera {{ translation 0.03 0 0.028 rotation {rotation} near 0.0055 zoom Zoom {{ }}
          fieldOfView {fields["camera_fieldOfView"]}
          width {fields["camera_width"]} height {fields["camera_height"]} }}
        Accelerometer {{ lookupTable [ -100 -100 0.003 100 100 0.003 ] }}
        Gyro {{ lookupTable [ -13.315805 -100000 0.003 13.315805 100000 0.003 ] }}
        Receiver {{ }} Emitter {{ }} Speaker {{ }}
        DEF turretSlot Pose {{ translation -0.0095 0 0.0486 }}
        DEF groundSensorsSlot Pose {{ translation 0.03 0 0.0003 }}
        Pose {{ translation 0 0 0.025 children Shape {{
          appearance PBRAppearance {{ baseColor 0.18 0.64 0.18 }}
          geometry Cylinder {{ height 0.045 radius 0.037 }} }} }}
      ]
      model "GCtronic e-puck{"2" if is_second else ""}"
      boundingObject Pose {{
        translation 0 0 0.025 children Cylinder {{ height 0.045 radius 0.037 }} }}
      physics Physics {{ density -1 mass {mass_kg} }} }}"""


def _wheel(side: str, left_m: float, max_radps: float) -> str:
    return f"""HingeJoint {{
        jointParameters HingeJointParameters {{ axis 0 1 0 anchor 0 0 0.02 }}
        device [
          RotationalMotor {{ name "{side} wheel motor" maxVelocity {max_radps} }}
          PositionSensor {{ name "{side} wheel sensor" resolution 0.00628 }} ]
        endPoint Solid {{ translation 0 {left_m} 0.02 name "{side} wheel"
          boundingObject Pose {{
            rotation 1 0 0 1.570796 children Cylinder {{ height 0.005 radius 0.02 }} }}
          physics Physics {{ density -1 mass 0.005 }} }} }}"""


def _eye(number: int, ahead_m: float, left_m: float, heading_rad: float) -> str:
    turned = f"rotation 0 0 1 {heading_rad}"
    return f"""DistanceSensor {{ translation {ahead_m} {left_m} 0.033 {turned} name "ps{number}"
        lookupTable [ {_PROXIMITY} ] type "infra-red" aperture 0.1 }}
      LightSensor {{ translation {ahead_m} {left_m} 0.0329 {turned} name "ls{number}"
        lookupTable [ 1 4095 0.01 2 0 0.01 ] }}"""
