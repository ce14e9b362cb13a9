"""Robot in a separate process: publishes frames of a room over Zenoh, some invalid messages, and receives the maps.

The arguments are the endpoint to connect to and the folder for the received messages.
"""

import json
import sys
import time
from pathlib import Path

import zenoh
import zenoh.ext

from tests.helpers.robot import ROS2, Messages, corridor_path, drive, robot_messages
from tests.helpers.rooms import tiny_room
from tests.helpers.toy_units import CAMERA


def main(endpoint: str, folder: Path) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "true")
    received: dict[str, bytes] = {}
    scene = tiny_room()
    frames = list(drive(scene, CAMERA, corridor_path(scene.free_space, 10)))
    block = zenoh.CongestionControl.BLOCK  # no message is lost on a busy machine
    with zenoh.open(config) as session:
        session.declare_subscriber(
            "imagination/*", lambda sample: received.update({str(sample.key_expr): sample.payload.to_bytes()})
        )
        latched = zenoh.ext.declare_advanced_publisher(
            session, "tf_static", cache=zenoh.ext.CacheConfig(max_samples=10), publisher_detection=True
        )
        messages = Messages(ROS2)
        topics = [name.strip("/") for name, *_ in robot_messages(frames[0], CAMERA, messages, False)]
        publishers = [session.declare_publisher(topic) for topic in dict.fromkeys(topics)]
        while not all(publisher.matching_status.matching for publisher in publishers):
            time.sleep(0.05)  # wait for the service
        start = time.time_ns()
        for number, taken in enumerate(frames):
            now = taken._replace(stamp=start + number * 10**8)
            session.put("camera/color/image_raw", b"\x00\x01\x00\x00 noise", congestion_control=block)
            session.put("tf", bytes(100_000), congestion_control=block)
            for topic, name, message in robot_messages(now, CAMERA, messages, not number):
                data = bytes(ROS2.serialize_cdr(message, name))
                if topic == "/tf_static":
                    latched.put(data)
                else:
                    session.put(topic.strip("/"), data, congestion_control=block)
            for _ in range(200):  # wait until the frame is mapped, so that none is dropped
                time.sleep(0.05)
                grid = received.get("imagination/occupancy")
                if (
                    grid
                    and ROS2.deserialize_cdr(grid, "nav_msgs/msg/OccupancyGrid").header.stamp.nanosec
                    == now.stamp % 10**9
                ):
                    break
        time.sleep(0.5)
    for name, data in received.items():
        (folder / name.replace("/", "_")).write_bytes(data)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
