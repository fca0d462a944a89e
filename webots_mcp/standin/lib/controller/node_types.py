"""Webots' numbers for node and field types."""

from __future__ import annotations

from typing import Final

_NUMBERED_WITHOUT_CONSTANT: Final = {"Pose": 26}

CONSTANTS: Final = {
    **{"NO_NODE": 0, "DIRECTIONAL_LIGHT": 0, "APPEARANCE": 1, "BACKGROUND": 2, "BILLBOARD": 3},
    **{"BOX": 4, "CAD_SHAPE": 5, "CAPSULE": 6, "COLOR": 7, "CONE": 8, "COORDINATE": 9},
    **{"CYLINDER": 10, "ELEVATION_GRID": 12, "FOG": 13, "GROUP": 14, "IMAGE_TEXTURE": 15},
    **{"INDEXED_FACE_SET": 16, "INDEXED_LINE_SET": 17, "MATERIAL": 18, "MESH": 19},
    **{"MUSCLE": 20, "NORMAL": 21, "PBR_APPEARANCE": 22, "PLANE": 23, "POINT_LIGHT": 24},
    **{"POINT_SET": 25, "SHAPE": 27, "SPHERE": 28, "SPOT_LIGHT": 29, "TEXTURE_COORDINATE": 30},
    **{"TEXTURE_TRANSFORM": 31, "TRANSFORM": 32, "VIEWPOINT": 33, "ROBOT": 34},
    **{"ACCELEROMETER": 35, "ALTIMETER": 36, "BRAKE": 37, "CAMERA": 38, "COMPASS": 39},
    **{"CONNECTOR": 40, "DISPLAY": 41, "DISTANCE_SENSOR": 42, "EMITTER": 43, "GPS": 44},
    **{"GYRO": 45, "INERTIAL_UNIT": 46, "LED": 47, "LIDAR": 48, "LIGHT_SENSOR": 49},
    **{"LINEAR_MOTOR": 50, "PEN": 51, "POSITION_SENSOR": 52, "RADAR": 54, "RANGE_FINDER": 55},
    **{"RECEIVER": 56, "ROTATIONAL_MOTOR": 57, "SKIN": 58, "SPEAKER": 59, "TOUCH_SENSOR": 60},
    **{"VACUUM_GRIPPER": 61, "BALL_JOINT": 62, "BALL_JOINT_PARAMETERS": 63, "CHARGER": 64},
    **{"CONTACT_PROPERTIES": 65, "DAMPING": 66, "FLUID": 67, "FOCUS": 68, "HINGE_JOINT": 69},
    **{"HINGE_JOINT_PARAMETERS": 70, "HINGE_2_JOINT": 71, "IMMERSION_PROPERTIES": 72},
    **{"JOINT_PARAMETERS": 73, "LENS": 74, "LENS_FLARE": 75, "PHYSICS": 76, "RECOGNITION": 77},
    **{"SLIDER_JOINT": 78, "SLOT": 79, "SOLID": 80, "SOLID_REFERENCE": 81, "TRACK": 82},
    **{"TRACK_WHEEL": 83, "WORLD_INFO": 84, "ZOOM": 85, "MICROPHONE": 86, "RADIO": 87},
}
"""The number of a node type by the name of its constant, as `DISTANCE_SENSOR`."""

_NAMES: Final = (
    *("Appearance", "Background", "Box", "Camera", "Capsule", "ContactProperties", "Cylinder"),
    *("DirectionalLight", "DistanceSensor", "GPS", "Group", "HingeJoint", "HingeJointParameters"),
    *("Accelerometer", "Compass", "Gyro", "LED", "LightSensor", "TouchSensor", "Zoom"),
    *("InertialUnit", "Lidar", "Material", "PBRAppearance", "Physics", "Plane", "PointLight"),
    *("PositionSensor", "Robot", "RotationalMotor", "Shape", "Solid", "Sphere"),
    *("SpotLight", "Transform", "Viewpoint", "WorldInfo"),
)

_NUMBER_OF_PLAIN: Final = {name.replace("_", ""): number for name, number in CONSTANTS.items()}

NUMBER_OF: Final = _NUMBERED_WITHOUT_CONSTANT | {
    name: _NUMBER_OF_PLAIN[name.upper()] for name in _NAMES
}
"""The number of a node type by the name that stands in world files."""

_SINGLE: Final = ("Bool", "Int32", "Float", "Vec2f", "Vec3f", "Rotation", "Color", "String", "Node")

FIELD_NUMBER_OF: Final = {
    prefix + kind: number + many
    for prefix, many in (("SF", 0), ("MF", 16))
    for number, kind in enumerate(_SINGLE, start=1)
}
"""The number of a field type by its name."""
