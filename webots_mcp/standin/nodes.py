"""The node types that the stand-in knows: their fields, types and default values.

Written as Webots writes its own node files. Default sounds and textures are left out: nothing here
is reported. A world may use other fields of these nodes; they are read over.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from webots_mcp.standin.vrml import Value, tokens_of

_DEFINITIONS: Final = """
WorldInfo {
  MFString info []  SFString title ""  SFString window "<none>"
  SFFloat gravity 9.81  SFFloat basicTimeStep 32  SFFloat FPS 60
  SFInt32 optimalThreadCount 1  SFInt32 randomSeed 0
  SFString coordinateSystem "ENU"  SFString gpsCoordinateSystem "local"
  MFNode contactProperties []
}
ContactProperties {
  SFString material1 "default"  SFString material2 "default"
  MFFloat coulombFriction 1  SFFloat bounce 0.5
}
Viewpoint {
  SFRotation orientation 0 0 1 0  SFVec3f position -10 0 0  SFFloat fieldOfView 0.785398
}
Background { MFColor skyColor 0 0 0  SFFloat luminosity 1 }
DirectionalLight {
  SFFloat ambientIntensity 0  SFColor color 1 1 1  SFVec3f direction 0 0 -1  SFFloat intensity 1
  SFBool on TRUE
}
PointLight {
  SFFloat ambientIntensity 0  SFVec3f attenuation 1 0 0  SFColor color 1 1 1  SFFloat intensity 1
  SFVec3f location 0 0 0  SFBool on TRUE
}
SpotLight {
  SFFloat ambientIntensity 0  SFVec3f attenuation 1 0 0  SFColor color 1 1 1  SFFloat intensity 1
  SFVec3f location 0 0 10  SFVec3f direction 0 0 -1  SFFloat cutOffAngle 0.785398
  SFFloat beamWidth 1.570796  SFBool on TRUE
}
Group { MFNode children [] }
Pose { SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children [] }
Transform {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFVec3f scale 1 1 1  MFNode children []
}
Solid {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "solid"  SFString model ""  SFString description ""
  SFString contactMaterial "default"  SFNode boundingObject NULL  SFNode physics NULL
  SFBool locked FALSE
}
Robot {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "robot"  SFString model ""  SFString description ""
  SFString contactMaterial "default"  SFNode boundingObject NULL  SFNode physics NULL
  SFBool locked FALSE
  SFString controller "<generic>"  MFString controllerArgs []  SFString customData ""
  SFBool supervisor FALSE  SFBool synchronization TRUE  MFFloat battery []
  SFBool selfCollision FALSE  SFString window "<generic>"
}
Shape { SFNode appearance NULL  SFNode geometry NULL }
PBRAppearance {
  SFColor baseColor 1 1 1  SFFloat transparency 0  SFFloat roughness 0  SFFloat metalness 1
}
Appearance { SFNode material NULL }
Material { SFColor diffuseColor 0.8 0.8 0.8 }
Plane { SFVec2f size 1 1 }
Box { SFVec3f size 0.1 0.1 0.1 }
Cylinder { SFFloat height 0.2  SFFloat radius 0.1  SFInt32 subdivision 32 }
Capsule { SFFloat height 0.2  SFFloat radius 0.1  SFInt32 subdivision 24 }
Sphere { SFFloat radius 0.1  SFInt32 subdivision 1  SFBool ico TRUE }
Physics { SFFloat density 1000  SFFloat mass -1  MFVec3f centerOfMass [] }
HingeJoint { SFNode jointParameters NULL  MFNode device []  SFNode endPoint NULL }
HingeJointParameters { SFFloat position 0  SFVec3f axis 1 0 0  SFVec3f anchor 0 0 0 }
SliderJoint { SFNode jointParameters NULL  MFNode device []  SFNode endPoint NULL }
JointParameters { SFFloat position 0  SFVec3f axis 0 0 1 }
LinearMotor {
  SFString name "linear motor"  SFFloat acceleration -1  SFVec3f controlPID 10 0 0
  SFFloat minPosition 0  SFFloat maxPosition 0  SFFloat maxVelocity 10  SFFloat maxForce 10
  SFFloat multiplier 1
}
RotationalMotor {
  SFString name "rotational motor"  SFFloat acceleration -1  SFVec3f controlPID 10 0 0
  SFFloat minPosition 0  SFFloat maxPosition 0  SFFloat maxVelocity 10  SFFloat maxTorque 10
  SFFloat multiplier 1
}
PositionSensor { SFString name "position sensor"  SFFloat noise 0  SFFloat resolution -1 }
DistanceSensor {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "distance sensor"  SFString model ""
  MFVec3f lookupTable [0 0 0 0.1 1000 0]
  SFString type "generic"  SFInt32 numberOfRays 1  SFFloat aperture 1.5708
}
Camera {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "camera"  SFString model ""
  SFFloat fieldOfView 0.7854  SFInt32 width 64  SFInt32 height 64  SFFloat near 0.01
  SFNode zoom NULL
}
Zoom { SFFloat maxFieldOfView 1.5  SFFloat minFieldOfView 0.5 }
Accelerometer {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "accelerometer"  SFString model ""  MFVec3f lookupTable []
  SFBool xAxis TRUE  SFBool yAxis TRUE  SFBool zAxis TRUE  SFFloat resolution -1
}
Compass {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "compass"  SFString model ""  MFVec3f lookupTable []
  SFBool xAxis TRUE  SFBool yAxis TRUE  SFBool zAxis TRUE  SFFloat resolution -1
}
Gyro {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "gyro"  SFString model ""  MFVec3f lookupTable []
  SFBool xAxis TRUE  SFBool yAxis TRUE  SFBool zAxis TRUE  SFFloat resolution -1
}
LED {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "led"  SFString model ""  MFColor color [1 0 0]  SFBool gradual FALSE
}
LightSensor {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "light sensor"  SFString model ""  MFVec3f lookupTable [0 0 0 1 1000 0]
  SFColor colorFilter 1 1 1  SFBool occlusion FALSE  SFFloat resolution -1
}
TouchSensor {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "touch sensor"  SFString model ""  SFNode boundingObject NULL
  SFNode physics NULL  SFString type "bumper"  MFVec3f lookupTable [0 0 0 5000 50000 0]
  SFFloat resolution -1
}
GPS {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "gps"  SFString model ""  SFString type "satellite"  SFFloat accuracy 0
}
InertialUnit {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "inertial unit"  SFString model ""  SFFloat noise 0
}
Lidar {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "lidar"  SFString model ""
  SFInt32 horizontalResolution 512  SFFloat fieldOfView 1.5708  SFFloat verticalFieldOfView 0.2
  SFInt32 numberOfLayers 4  SFFloat near 0.01  SFFloat minRange 0.01  SFFloat maxRange 1
  SFString type "fixed"  SFFloat defaultFrequency 10
  SFFloat minFrequency 1  SFFloat maxFrequency 25
}
"""

NUMBERS_IN: Final = {"Vec2f": 2, "Vec3f": 3, "Color": 3, "Rotation": 4}
"""How many numbers make one value of a type; all other types take one."""


@dataclass(frozen=True)
class FieldDefinition:
    """What a node type says about one of its fields."""

    type_name: str
    """`SFVec3f`, `MFNode` and so on."""
    default: Value
    """As the parser would have read it from a file."""


def definitions_in(text: str) -> dict[str, dict[str, FieldDefinition]]:
    """Fields by node type, from a text as Webots writes its node files, without comments."""
    words = [token.text for token in tokens_of(text)]
    known: dict[str, dict[str, FieldDefinition]] = {}
    start = 0
    while start < len(words):
        end = words.index("}", start)
        known[words[start]] = dict(_fields(words[start + 2 : end]))
        start = end + 1
    return known


def _fields(words: list[str]) -> list[tuple[str, FieldDefinition]]:
    starts = [i for i, word in enumerate(words) if word[:2] in ("SF", "MF")]
    return [
        (words[start + 1], FieldDefinition(words[start], _default(words[start + 2 : end])))
        for start, end in zip(starts, [*starts[1:], len(words)], strict=True)
    ]


def _default(words: list[str]) -> Value:
    if words[0] in ("TRUE", "FALSE"):
        return words[0] == "TRUE"
    if words[0] == "NULL":
        return None
    if words[0].startswith('"'):
        return words[0][1:-1]
    return [float(word) for word in words if word not in "[]"]


NODE_TYPES: Final = definitions_in(_DEFINITIONS)
"""Fields by node type."""

DEVICE_TYPES: Final = (
    *(
        "RotationalMotor",
        "LinearMotor",
        "PositionSensor",
        "DistanceSensor",
        "Camera",
        "GPS",
        "InertialUnit",
    ),
    *("Lidar", "Accelerometer", "Compass", "Gyro", "LED", "LightSensor", "TouchSensor"),
)

DEFAULT_NAME_OF: Final = {
    **{"Altimeter": "altimeter", "Brake": "brake", "Connector": "connector"},
    **{"Display": "display", "Emitter": "emitter", "Pen": "pen"},
    **{"Radar": "radar", "RangeFinder": "range-finder", "Receiver": "receiver", "Skin": "skin"},
    **{"Speaker": "speaker", "VacuumGripper": "vacuum gripper"},
}
"""What devices that the stand-in does not have are called, unless the world gives them a name."""
