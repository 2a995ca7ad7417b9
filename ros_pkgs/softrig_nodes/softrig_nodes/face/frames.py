"""/tf and /tf_static of a node: the positions of the frames in which its messages and drawings are expressed."""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from softrig_core.block.scene import Pose, scene_of, standing
from softrig_core.timebase import SECOND
from softrig_core.wire.stream import Writer

from ..adapter.adapter import Adapter
from ..below.tf_message import TF
from ..below.uses import sending
from ..ros.messages import message_class
from ..ros.ros import QOS

PERIOD = SECOND // 30  # ns of the wall between two sets of moving frames: a viewer's pictures


class Frames:
    """Publishes fixed frames on /tf_static, latched, and moving frames on /tf while it has subscribers."""

    def __init__(self, node: Node, adapter: Adapter) -> None:
        self._adapter = adapter
        block = adapter.block
        scene = self._scene = scene_of(type(block), block.p)
        still = standing(adapter.step.markers(), scene, adapter.step.outputs)
        if still:
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            sending(node.create_publisher(message_class(TF), "/tf_static", latched))(encode(0, still))
        if scene is None:
            return
        self._tf = node.create_publisher(message_class(TF), "/tf", QOS)
        port = next(p for p in adapter.step.outputs if p.name == scene.port)
        self._positions = [k for k, label in enumerate(port.labels) if label.endswith("/position")]
        self._stamp = -1
        adapter.middleware.timer(PERIOD, self._move)

    def _move(self) -> None:
        adapter, scene = self._adapter, self._scene
        # Without subscribers the work is saved.
        if adapter.state != "running" or scene is None or not self._tf.get_subscription_count():
            return
        newest = adapter.step.newest(scene.port)
        stamp = adapter.epoch + adapter.step.t
        # tf2 warns about a transform that is published twice.
        if newest and stamp != self._stamp:
            self._stamp = stamp
            sending(self._tf)(encode(stamp, scene.moving([newest[k] for k in self._positions])))


def encode(stamp: int, poses: Iterable[Pose]) -> bytes:
    """Return the bytes of a tf2_msgs/msg/TFMessage.

    Parameters
    ----------
    stamp : int
        ns.
    """
    poses = list(poses)
    writer = Writer()
    writer.add("I", len(poses))
    for pose in poses:
        writer.add("I", stamp // SECOND, stamp % SECOND)
        writer.text(pose.parent)
        writer.text(pose.child)
        writer.add("d", *pose.position, *pose.rotation)
    return bytes(writer.data)
