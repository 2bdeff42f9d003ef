"""Which robot a log is of."""

import pytest

from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.logs.robots import find_robot
from tcpipe.logs.topics import Topic


@pytest.mark.parametrize(
    ("namespace", "name", "why"),
    [
        ("/a200_0123", "husky", "is called so"),
        ("/j100_0001", "jackal", "is called so"),
        ("/w200_0001", "warthog", "is called so"),
        ("/do150_0001", "dingo", "is called so"),
        ("/r100-0001", "ridgeback", "is called so"),
        ("/a300_0001", "husky_a300", "is called so"),
        ("/x400_0001", "generic", "the platform X400, which no profile knows"),
        ("", "husky", "nothing names another platform"),
        ("/room100_0001", "husky", "nothing names another platform"),
    ],
)
def test_a_clearpath_robot_is_known_by_its_namespace(namespace, name, why):
    topic = Topic(f"{namespace}/platform/mcu/status/power", "clearpath_platform_msgs/msg/Power", 1, 0, 0, "cdr", "")
    robot, said = find_robot([topic], None, load_shipped_profiles().robots)
    assert robot == name
    assert why in said
