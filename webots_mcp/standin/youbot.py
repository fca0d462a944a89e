"""The youBot: where its wheels and joints are and how far they turn, as boxes and cylinders.

Its wheels drive ahead and turn; they do not drive sideways as Mecanum wheels do. What the arm and
the fingers hold is not modelled: they move, and touch nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

YOUBOT: Final = """
Youbot {
  SFVec3f translation 0 0 0.102  SFRotation rotation 0 0 1 0  SFString name "youBot"
  SFString controller "youbot"  MFString controllerArgs []  SFString window "<generic>"
  SFString customData ""  SFBool supervisor FALSE  SFBool synchronization TRUE
  MFNode bodySlot []  SFInt32 numberOfArms 1
}
"""
"""The fields of the PROTO."""

_WHEELS: Final = ((0.228, -0.158), (0.228, 0.158), (-0.228, -0.158), (-0.228, 0.158))
_ARM: Final = (  # axis, anchor in metres from the joint before, lowest and highest angle
    ("0 0 1", "0 0 0.077", -2.9496, 2.9496),
    ("0 -1 0", "0.033 0 0.07", -1.13446, 1.5708),
    ("0 -1 0", "0 0 0.155", -2.63545, 2.54818),
    ("0 -1 0", "0 0 0.135", -1.78024, 1.78024),
    ("0 0 1", "0 0 0.081", -2.92343, 2.92343),
)


def youbot(fields: Mapping[str, Any]) -> str:
    """What a youBot is made of, written as in a world file, from its fields."""
    wheels = " ".join(_wheel(number, *place) for number, place in enumerate(_WHEELS, 1))
    arm = f'Solid {{ translation 0.156 0 0 name "arm" children {_arm()} }}'
    return f"""Robot {{ children [ {wheels}
        {arm if fields["numberOfArms"] else ""}
        DEF bodySlot Group {{ }}
        Pose {{ translation 0 0 -0.02 children Shape {{
          appearance PBRAppearance {{ baseColor 0.95 0.5 0.1 }}
          geometry Box {{ size 0.58 0.38 0.08 }} }} }}
      ]
      model "KUKA youBot"
      boundingObject Pose {{
        translation 0 0 -0.045 children Box {{ size 0.56 0.34 0.09 }} }}
      physics Physics {{ density -1 mass 22 }} }}"""


def _wheel(number: int, ahead_m: float, left_m: float) -> str:
    place = f"{ahead_m} {left_m} -0.055"
    return f"""HingeJoint {{
        jointParameters HingeJointParameters {{ axis 0 1 0 anchor {place} }}
        device [
          RotationalMotor {{ name "wheel{number}" maxVelocity 14.81 }}
          PositionSensor {{ name "wheel{number}sensor" }} ]
        endPoint Solid {{ translation {place} name "wheel{number}"
          boundingObject Pose {{
            rotation 1 0 0 1.570796 children Cylinder {{ height 0.05 radius 0.05 }} }}
          physics Physics {{ density -1 mass 1.4 }} }} }}"""


def _arm(number: int = 1) -> str:
    """The joint `number` and all behind it; the last carries the two fingers."""
    axis, anchor, low_rad, high_rad = _ARM[number - 1]
    behind = _arm(number + 1) if number < len(_ARM) else f"[ {_finger('left')} {_finger('right')} ]"
    return f"""HingeJoint {{
        jointParameters HingeJointParameters {{ axis {axis} anchor {anchor} }}
        device [
          RotationalMotor {{ name "arm{number}" maxVelocity 1.5708
            minPosition {low_rad} maxPosition {high_rad} }}
          PositionSensor {{ name "arm{number}sensor" }} ]
        endPoint Solid {{ translation {anchor} name "arm{number}" children {behind} }} }}"""


def _finger(side: str) -> str:
    axis = "0 1 0" if side == "left" else "0 -1 0"
    return f"""SliderJoint {{
        jointParameters JointParameters {{ axis {axis} }}
        device [
          LinearMotor {{ name "finger::{side}" minPosition 0 maxPosition 0.025 }}
          PositionSensor {{ name "finger::{side}sensor" }} ]
        endPoint Solid {{ translation 0 0 0.09 name "finger {side}" }} }}"""
