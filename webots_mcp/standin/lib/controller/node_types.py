"""Numbers for node and field types.

Field types have Webots' numbers. Node types have numbers of the stand-in's own: compare with
`Node.GPS`, never with a number.
"""

from __future__ import annotations

import re
from typing import Final

_NAMES: Final = (
    *("Appearance", "Background", "Box", "Camera", "ContactProperties", "Cylinder"),
    *("DirectionalLight", "DistanceSensor", "GPS", "Group", "HingeJoint", "HingeJointParameters"),
    *("InertialUnit", "Lidar", "Material", "PBRAppearance", "Physics", "Plane", "PointLight"),
    *("Pose", "PositionSensor", "Robot", "RotationalMotor", "Shape", "Solid", "Sphere"),
    *("SpotLight", "Transform", "Viewpoint", "WorldInfo"),
)
_WORD_START: Final = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")

NUMBER_OF: Final = {name: number for number, name in enumerate(_NAMES, start=1)}
"""The number of a node type by the name that stands in world files."""

CONSTANTS: Final = {
    _WORD_START.sub("_", name).upper(): number for name, number in NUMBER_OF.items()
}
"""The number of a node type by the name of its constant, as `DISTANCE_SENSOR`; `NO_NODE` is 0."""
CONSTANTS["NO_NODE"] = 0

_SINGLE: Final = ("Bool", "Int32", "Float", "Vec2f", "Vec3f", "Rotation", "Color", "String", "Node")

FIELD_NUMBER_OF: Final = {
    prefix + kind: number + many
    for prefix, many in (("SF", 0), ("MF", 16))
    for number, kind in enumerate(_SINGLE, start=1)
}
"""The number of a field type by its name."""
