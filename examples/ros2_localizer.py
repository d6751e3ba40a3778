"""A ROS 2 node that asks a server of maps for the pose of its camera.

    ros2 run ... ros2_localizer.py --ros-args -p url:=http://localhost:8000

Subscribes to `image/compressed` and `camera_info`, publishes the pose of the camera in the map on `pose`. The
conversions are functions of messages alone; they are tested without ROS.
"""

from typing import Any

import pycolmap

import slimsfm
from slimsfm.errors import SlimsfmError


def camera_of(info: Any) -> pycolmap.Camera:
    """The intrinsics of a `sensor_msgs/CameraInfo` of a rectified image."""
    fx, _, cx, _, fy, cy = list(info.k)[:6]
    return pycolmap.Camera(model="PINHOLE", width=info.width, height=info.height, params=[fx, fy, cx, cy])


def fill_pose(message: Any, header: Any, cam_from_world: pycolmap.Rigid3d, frame: str) -> Any:
    """Fill a `geometry_msgs/PoseStamped`: where the camera (x right, y down, z forward) is in the map."""
    world_from_cam = cam_from_world.inverse()
    message.header.stamp, message.header.frame_id = header.stamp, frame
    place, turn = message.pose.position, message.pose.orientation
    place.x, place.y, place.z = world_from_cam.translation.tolist()
    turn.x, turn.y, turn.z, turn.w = world_from_cam.rotation.quat.tolist()
    return message


def main() -> None:
    """Run the node."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, CompressedImage

    class Localizer(Node):
        def __init__(self) -> None:
            super().__init__("slimsfm_localizer")
            self.declare_parameter("url", "http://localhost:8000")
            self.client = slimsfm.Client(self.get_parameter("url").value)
            self.camera: pycolmap.Camera | None = None
            self.publisher = self.create_publisher(PoseStamped, "pose", 10)
            self.create_subscription(CameraInfo, "camera_info", self.on_info, qos_profile_sensor_data)
            self.create_subscription(CompressedImage, "image/compressed", self.on_image, 1)

        def on_info(self, info: CameraInfo) -> None:
            self.camera = camera_of(info)

        def on_image(self, image: CompressedImage) -> None:
            try:
                found = self.client.localize(bytes(image.data), camera=self.camera)
            except SlimsfmError as error:
                self.get_logger().warning(str(error))
                return
            if found.cam_from_world is not None:
                self.publisher.publish(
                    fill_pose(PoseStamped(), image.header, found.cam_from_world, found.map)
                )

    rclpy.init()
    rclpy.spin(Localizer())


if __name__ == "__main__":
    main()
