"""CDR coding of ROS 2 messages with rosbags' type store, and conversion of maps to messages."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from imagination.geometry.grid import Grid
from imagination.mapping.semantic_map import Layer, MapObject
from imagination.recordings.trajectory import SECOND
from imagination.utils.errors import UserError, check_choice, require_extra

GRID, MARKERS = "nav_msgs/msg/OccupancyGrid", "visualization_msgs/msg/MarkerArray"

LINE_STRIP, TEXT, ADD, DELETE_ALL = 4, 9, 0, 3
"""Types and actions of visualization_msgs/Marker."""


class Codec:
    """Encodes and decodes messages of one ROS 2 distribution.

    Args:
        distribution: name of the distribution in rosbags, e.g. ros2_humble.
        max_bytes: largest size of a message, bytes.

    Raises:
        UserError: if rosbags is not installed or does not support the distribution.
    """

    def __init__(self, distribution: str, max_bytes: int) -> None:
        require_extra("rosbags", "ros")
        from rosbags.typesys import Stores, get_typestore

        names = [store.value for store in Stores if store.value.startswith("ros2")]
        self._store = get_typestore(Stores(check_choice("transport.distribution", distribution, names)))
        self.max_bytes = max_bytes

    def decode(self, data: bytes, kind: str) -> Any:
        """Decode a message of type `kind`.

        Raises:
            UserError: if the message is too large or its bytes are invalid.
        """
        if len(data) > self.max_bytes:
            raise UserError(f"{kind}: got {len(data)} bytes, expected at most {self.max_bytes}")
        try:
            return self._store.deserialize_cdr(data, kind)
        except Exception as error:  # the decoder raises many types on invalid bytes
            raise UserError(f"{kind}: got {len(data)} bytes that cannot be decoded ({error!r})") from error

    def encode(self, message: Any, kind: str) -> bytes:
        """Encode a message of type `kind`."""
        return bytes(self._store.serialize_cdr(message, kind))

    def occupancy_grid(self, layer: Layer, grid: Grid, frame: str, stamp: int) -> Any:
        """Convert a layer to nav_msgs/OccupancyGrid, whose first row is the lowest."""
        x, y = grid.origin
        info = self._make(
            "nav_msgs/MapMetaData",
            map_load_time=self._time(stamp),
            resolution=grid.resolution,
            width=grid.columns,
            height=grid.rows,
            origin=self._pose(x, y, 0.0),
        )
        data = np.ascontiguousarray(layer[::-1]).reshape(-1)
        return self._make("nav_msgs/OccupancyGrid", header=self._header(stamp, frame), info=info, data=data)

    def markers(
        self, objects: Sequence[MapObject], colours: dict[str, tuple[int, int, int]], frame: str, stamp: int
    ) -> Any:
        """Convert objects to visualization_msgs/MarkerArray: outline, and category with confidence, of each object."""
        markers = [self._marker(stamp, frame, "", 0, DELETE_ALL, (0, 0, 0))]
        for number, obj in enumerate(objects):
            colour = colours[obj.category]
            outline = self._marker(stamp, frame, obj.category, number, ADD, colour)
            corners = [*obj.outline.tolist(), obj.outline[0].tolist()]
            outline.type, outline.scale.x = LINE_STRIP, 0.03
            outline.points = [self._make("geometry_msgs/Point", x=x, y=y, z=0.0) for x, y in corners]
            text = self._marker(stamp, frame, f"{obj.category} text", number, ADD, colour)
            text.type, text.scale.z = TEXT, 0.2
            text.text = f"{obj.category} {obj.confidence:.2f}"
            text.pose = self._pose(*obj.centre, 0.3)
            markers += [outline, text]
        return self._make("visualization_msgs/MarkerArray", markers=markers)

    def _marker(
        self, stamp: int, frame: str, namespace: str, number: int, action: int, colour: tuple[int, int, int]
    ) -> Any:
        red, green, blue = (value / 255 for value in colour)
        values: dict[str, Any] = {
            "header": self._header(stamp, frame),
            "ns": namespace,
            "id": number,
            "type": LINE_STRIP,
            "action": action,
            "pose": self._pose(0.0, 0.0, 0.0),
            "scale": self._make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0),
            "color": self._make("std_msgs/ColorRGBA", r=red, g=green, b=blue, a=1.0),
            "lifetime": self._make("builtin_interfaces/Duration", sec=0, nanosec=0),
            "frame_locked": False,
            "points": [],
            "colors": [],
            "text": "",
            "mesh_resource": "",
            "mesh_use_embedded_materials": False,
        }
        fields = self._store.types["visualization_msgs/msg/Marker"].__dataclass_fields__
        if "texture_resource" in fields:  # since Humble
            empty = np.zeros(0, np.uint8)
            image = self._make(
                "sensor_msgs/CompressedImage", header=self._header(0, ""), format="", data=empty
            )
            mesh = self._make("visualization_msgs/MeshFile", filename="", data=empty)
            values |= {"texture_resource": "", "texture": image, "uv_coordinates": [], "mesh_file": mesh}
        return self._make("visualization_msgs/Marker", **values)

    def _pose(self, x: float, y: float, z: float) -> Any:
        position = self._make("geometry_msgs/Point", x=x, y=y, z=z)
        turn = self._make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        return self._make("geometry_msgs/Pose", position=position, orientation=turn)

    def _header(self, stamp: int, frame: str) -> Any:
        return self._make("std_msgs/Header", stamp=self._time(stamp), frame_id=frame)

    def _time(self, stamp: int) -> Any:
        return self._make("builtin_interfaces/Time", sec=stamp // SECOND, nanosec=stamp % SECOND)

    def _make(self, name: str, **values: Any) -> Any:
        package, kind = name.split("/")
        return self._store.types[f"{package}/msg/{kind}"](**values)
