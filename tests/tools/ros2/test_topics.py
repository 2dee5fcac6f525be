"""Keys and tokens of topics, against those that rmw_zenoh's and the bridge's documents show."""

import numpy as np
import pytest
from support.ros_messages import RosMessages
from triquad_tools.commands.ros2 import parser
from triquad_tools.ros2.options import Role, TopicChoice
from triquad_tools.ros2.output.mesh_publisher import ADD, marker_message
from triquad_tools.ros2.topics import (
    ATTACHMENT,
    NODE_NAME,
    Announcement,
    Delivery,
    End,
    SequenceGaps,
    Topic,
    bridge_token,
    read_token,
    rmw_key,
    rmw_prefix,
    rmw_token,
    rmw_topic_name,
    type_hash,
)
from triquad_tools.work.ros2 import bridge_options

STRING = "std_msgs/msg/String"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = Topic("/chatter", STRING)
SESSION = "aac3178e146ba6f1fc6e6a4085e77f21"
# docs/design.md of rmw_zenoh has these two, of a node ``listener``.
NODE = f"@ros2_lv/2/{SESSION}/0/0/NN/%/%/{NODE_NAME}"
SUBSCRIPTION = (
    f"@ros2_lv/2/{SESSION}/0/10/MS/%/%/{NODE_NAME}/%chatter/"
    f"std_msgs::msg::dds_::String_/{HASH}/::,10:,:,:,,"
)


def test_keys_are_those_of_the_documents() -> None:
    assert type_hash(STRING) == HASH
    assert rmw_key(0, CHATTER, HASH) == f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"
    namespaced = rmw_key(0, Topic("/robot1/chatter", STRING), HASH)
    assert namespaced == f"0/robot1/chatter/std_msgs::msg::dds_::String_/{HASH}"
    assert rmw_topic_name(namespaced) == "/robot1/chatter"


def test_tokens_are_those_of_the_documents() -> None:
    assert rmw_prefix(2, SESSION, 0, "NN") == NODE
    what = Announcement(End.SUBSCRIPTION, CHATTER, HASH)
    prefix = rmw_prefix(2, SESSION, 10, what.end.value)
    assert rmw_token(prefix, what, Delivery(depth=10)) == SUBSCRIPTION
    assert read_token(SUBSCRIPTION) == what


def test_tokens_of_bridges_are_read_as_they_are_written() -> None:
    what = Announcement(End.PUBLISHER, Topic("/robot1/lidar/points", STRING), HASH)
    token = bridge_token("ab12", what, Delivery(latched=True, depth=1))
    assert token == (
        f"@/ab12/@ros2_lv/MP/robot1§lidar§points/std_msgs§msg§String/:1:1:0,1:typehash={HASH};"
    )
    read = read_token(token)
    assert read is not None
    assert (read.end, read.topic) == (what.end, what.topic)


@pytest.mark.parametrize(
    "token",
    [
        NODE,
        "",
        "@",
        "@/x/@ros2_lv",
        SUBSCRIPTION.replace("/MS/", "/SS/"),
        SUBSCRIPTION.replace("std_msgs::msg::dds_::String_", "String"),
        SUBSCRIPTION + "/more",
        "@/x/@ros2_lv/SS/key/type/qos",
    ],
)
def test_tokens_that_say_nothing_of_topics_are_left_alone(token: str) -> None:
    assert read_token(token) is None


def choice(*arguments: str) -> TopicChoice:
    return bridge_options(parser().parse_args(arguments)).topics


def test_options_choose_topics_with_and_without_slashes() -> None:
    chosen = choice(
        "--namespace", "robot1", "--clouds", "front/points", "--depth", "cam/depth/image"
    )
    assert chosen.clouds == ("/robot1/front/points",)
    keys = {feed.key: feed.role for feed in chosen.feeds()}
    assert keys["robot1/cam/depth/camera_info"] is Role.CAMERA_INFO
    assert keys["robot1/tf"] is Role.TF
    assert chosen.wants(Topic("/robot1/rear/points", "sensor_msgs/msg/PointCloud2")) is None
    assert (chosen.mesh, chosen.grid) == ("/robot1/triquad/mesh", "/robot1/triquad/grid")
    everything = choice()
    assert everything.wants(Topic("/rear/points", "sensor_msgs/msg/PointCloud2")) is Role.CLOUD
    assert everything.wants(Topic("/rear/points", STRING)) is None
    assert everything.poses is None
    assert choice("--poses", "/tf").poses is None


@pytest.mark.parametrize("frame", ["map", "a", "odometry frame"])
@pytest.mark.parametrize("triangles", [0, 1, 5])
def test_markers_are_read_by_others_as_they_were_meant(frame: str, triangles: int) -> None:
    corners = np.random.default_rng(1).normal(size=(3 * triangles, 3))
    payload = marker_message(frame, 7, ADD, corners)
    types = RosMessages().types
    marker = types.deserialize_cdr(payload, "visualization_msgs/msg/Marker")
    assert (marker.header.frame_id, marker.id, marker.action) == (frame, 7, 0)
    assert [(p.x, p.y, p.z) for p in marker.points] == [tuple(each) for each in corners]
    assert bytes(types.serialize_cdr(marker, "visualization_msgs/msg/Marker")) == payload


def test_numbers_that_are_missing_are_told_by_publisher() -> None:
    gaps = SequenceGaps()

    def missed(number: int, publisher: bytes = b"a" * 16) -> int:
        return gaps.missed(ATTACHMENT.pack(number, 0, 16, publisher))

    assert [missed(n) for n in (5, 6, 9, 7, 8)] == [0, 0, 2, 0, 0]
    assert missed(1, b"b" * 16) == 0
    assert missed(9) == 0
    assert gaps.missed(b"another form") == 0
    for number in (-(2**63), 2**63 - 1, -(2**63), -5, 5, 2**40, 3):
        assert missed(number) == 0, "a publisher that was started again, or wrong bytes"
    assert missed(5) == 1
    for number in range(1000):
        assert missed(number, number.to_bytes(16, "little")) == 0
