"""Two robots are told from one robot with a camera that has sensors of its own."""

from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.logs import roles
from tcpipe.logs.robots import find_robot_namespaces
from tcpipe.logs.topics import Topic

KINDS = {"fix": "sensor_msgs/msg/NavSatFix", "imu": "sensor_msgs/msg/Imu", "odom": "nav_msgs/msg/Odometry"}


def assign_roles(*given, **named):
    return roles.assign_roles(*given, **named, known=load_shipped_profiles())


def test_three_roles_in_two_namespaces_are_two_robots():
    found = find_robot_namespaces({name: [f"/a/{name}", f"/b/x/{name}"] for name in ("gnss", "imu", "power")})
    assert found == {"/a": ("gnss", "imu", "power"), "/b": ("gnss", "imu", "power")}


def test_a_camera_and_a_controller_are_no_robots():
    candidates = {
        "imu": ["/imu/data", "/zed2/imu/data"],
        "visual_odometry": ["/zed2/zed_node/odom"],
        "wheel_odometry": ["/husky_velocity_controller/odom", "/platform/odom"],
        "command": ["/husky_velocity_controller/cmd_vel", "/platform/cmd_vel"],
        "gnss": ["/fix"],
    }
    assert find_robot_namespaces(candidates) == {}


def assign(namespace=None, chosen=None):
    names = [f"/{robot}/{name}" for robot in ("anna", "bert") for name in KINDS]
    topics = [Topic(name, KINDS[name.rsplit("/", 1)[1]], 9, 0, 10, "cdr", "") for name in [*names]]
    return assign_roles(topics, chosen or {}, namespace=namespace)


def test_the_namespace_answers_the_question():
    question = assign().problems
    assert question[0].startswith("the log holds 2 robots")
    assert question[-1].startswith('namespace = "/anna"')
    for name in ("/bert", "bert", "/bert/"):
        found = assign(name)
        assert found.problems == ()
        assert {topic for role in found.roles.values() for topic in role.topics} == {f"/bert/{kind}" for kind in KINDS}


def test_topics_chosen_by_name_need_no_namespace():
    chosen = {"gnss": ["/anna/fix"], "imu": ["/bert/imu"], "wheel_odometry": ["/anna/odom"]}
    assert assign(chosen=chosen).problems == ()


def test_a_namespace_that_holds_nothing_is_a_mistake():
    assert "no topic lies below /carl" in assign("/carl").problems[0]
