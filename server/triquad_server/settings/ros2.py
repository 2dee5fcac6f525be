"""Settings of the connection with ROS 2: the section ``[ros2]`` of the server's settings."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, Field, model_validator
from triquad_tools.sensors.ros.header import frame_name

from triquad_server.settings.section import SECTION

_NAME = r"[A-Za-z_][A-Za-z0-9_]*"
_TOPIC = rf"(/?{_NAME})+"

Topic = Annotated[str, Field(pattern=rf"^{_TOPIC}$", max_length=255)]
TopicOrNone = Annotated[str, Field(pattern=rf"^({_TOPIC})?$", max_length=255)]
Frame = Annotated[str, AfterValidator(frame_name)]  # written as those of messages are read

MAX_GRID_CELLS = 250_000
TF_POSES = "tf"


class Ros2Settings(BaseModel):
    """What is taken from topics of ROS 2, and what is published on some."""

    model_config = SECTION

    enabled: bool = False
    """Take in clouds and poses of ROS 2 and publish the map there; the flag `--ros2` says the
    same."""

    domain: Annotated[int, Field(ge=0, le=232)] = 0
    """`ROS_DOMAIN_ID` of the robot, for rmw_zenoh; a bridge has its own."""

    namespace: TopicOrNone = ""
    """Goes before the name of every topic, those of transforms and of outputs too: the namespace
    of the robot, or that of its bridge."""

    clouds: list[Topic] = []
    """Topics of `PointCloud2` that are mapped; by default all that there are, or none where `depth`
    names topics."""

    depth: list[Topic] = []
    """Topics of depth images that are mapped; the `camera_info` beside each gives the camera."""

    depth_stride: Annotated[int, Field(ge=1, le=64)] = 2
    """Of a depth image, every so many-th row and column is taken."""

    poses: Topic = TF_POSES
    """Where poses come from: `"tf"`, or a topic of `Odometry` or `PoseStamped`, with which of the
    transforms only the static ones count."""

    body_frame: Frame = "base_link"
    """The frame whose pose a topic of `PoseStamped` gives."""

    map_frame: Frame = ""
    """The frame in which the map is made; by default `map`, `odom` or `world`, the first that the
    transforms have, or that of the topic of poses."""

    clock: Literal["header", "arrival"] = "header"
    """The time of messages: what their header says, or when they arrived, for sensors whose
    clock is not that of the poses."""

    waiting_clouds: Annotated[int, Field(ge=1, le=1000)] = 32
    """Clouds that wait for their transforms; of more, or of more than 512 MB, the oldest is given
    up, and counted."""

    waiting_s: Annotated[float, Field(ge=0, le=60)] = 2.0
    """How long a cloud waits for its transforms."""

    mesh_topic: TopicOrNone = "/triquad/mesh"
    """The mesh as `visualization_msgs/Marker`, while somebody listens; empty: never."""

    mesh_level: Annotated[int, Field(ge=0, le=2)] = 1
    """Level of detail of that mesh: 1 and 2 have cells of twice and four times the side of 0."""

    mesh_bytes_per_s: Annotated[int, Field(ge=1000, le=2**40)] = 5_000_000
    """No more of the mesh is published a second."""

    grid_topic: TopicOrNone = "/triquad/grid"
    """A slice of the map as `nav_msgs/OccupancyGrid`, while somebody listens; empty: never."""

    grid_height_m: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.5
    """Height of the slice in the map frame."""

    grid_side_m: Annotated[float, Field(ge=0.1, le=10_000)] = 40.0
    """Side of the slice, around where the newest scan was taken."""

    grid_cell_m: Annotated[float, Field(ge=0.01, le=10)] = 0.1
    """Side of its cells, of which there are at most 250,000."""

    grid_period_s: Annotated[float, Field(ge=0.1, le=3600)] = 1.0
    """Time between two slices, while the map or the place changes."""

    @property
    def grid_cells(self) -> int:
        """Cells along the side of the slice."""
        return max(1, round(self.grid_side_m / self.grid_cell_m))

    @model_validator(mode="after")
    def _grid_is_bounded(self) -> "Ros2Settings":
        if self.grid_cells**2 > MAX_GRID_CELLS:
            raise ValueError(
                f"ros2.grid_side_m = {self.grid_side_m:g} has too many cells of ros2.grid_cell_m = "
                f"{self.grid_cell_m:g}: use at most {int(MAX_GRID_CELLS**0.5)} along a side"
            )
        return self
