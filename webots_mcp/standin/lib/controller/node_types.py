"""Numbers for node and field types.

Field types have Webots' numbers. Node types have numbers of the stand-in's own: compare with
`Node.GPS`, never with a number.
"""

NODE_TYPES = (
    "NO_NODE APPEARANCE BACKGROUND BOX CAMERA CONTACT_PROPERTIES CYLINDER DIRECTIONAL_LIGHT "
    "DISTANCE_SENSOR GPS GROUP HINGE_JOINT HINGE_JOINT_PARAMETERS INERTIAL_UNIT LIDAR MATERIAL "
    "PBR_APPEARANCE PHYSICS PLANE POINT_LIGHT POSE POSITION_SENSOR ROBOT ROTATIONAL_MOTOR SHAPE "
    "SOLID SPHERE SPOT_LIGHT TRANSFORM VIEWPOINT WORLD_INFO"
).split()

_NAMES = (
    "- Appearance Background Box Camera ContactProperties Cylinder DirectionalLight "
    "DistanceSensor GPS Group HingeJoint HingeJointParameters InertialUnit Lidar Material "
    "PBRAppearance Physics Plane PointLight Pose PositionSensor Robot RotationalMotor Shape "
    "Solid Sphere SpotLight Transform Viewpoint WorldInfo"
).split()

NUMBER_OF = {name: number for number, name in enumerate(_NAMES)}
"""The number of a node type by the name that stands in world files."""

_SINGLE = ("Bool", "Int32", "Float", "Vec2f", "Vec3f", "Rotation", "Color", "String", "Node")

FIELD_NUMBER_OF = {
    prefix + kind: number + many
    for prefix, many in (("SF", 0), ("MF", 16))
    for number, kind in enumerate(_SINGLE, start=1)
}
"""The number of a field type by its name."""
