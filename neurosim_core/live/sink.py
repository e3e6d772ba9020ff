"""A flight as it goes to other processes, as fast as it is computed: a sink that publishes over Cortex."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from neurosim_core.packets import Collision, Packet
from neurosim_core.registry import register
from neurosim_core.sinks import Sink, SinkConfig, SinkContext

if TYPE_CHECKING:
    from cortex import Publisher


@register("sink", "cortex")
class CortexSinkConfig(SinkConfig):
    """Publishes all packets under the topics that `neurosim serve` has."""

    kind: Literal["cortex"] = "cortex"
    wait_s: Annotated[float, Field(ge=0.0, le=3600.0)] = 0.0
    """Longest wait for a subscriber of each sensor before the flight begins [wall-clock s]."""

    is_live = False

    def open(self, context: SinkContext) -> Sink:
        """Return the publishers."""
        return CortexSink(self, context)


class CortexSink:
    """Publishes the packets of one flight; readers that are `reliable` hold it up."""

    def __init__(self, config: CortexSinkConfig, context: SinkContext) -> None:
        """Open the topics of all sensors."""
        from cortex import Node
        from neurosim_core.live import messages, topics

        self._to_message = messages.to_message
        self._vehicle = next(iter(context.model.config.vehicles))
        self._node = Node("flight")
        self._publishers: dict[str, tuple[Publisher[Any], str]] = {}
        for sensor in context.header.sensors:
            topic = topics.stream_topic(self._vehicle, sensor.name)
            packet = context.model.config.sensors[sensor.name].packet_class
            publisher = self._node.publisher(topic, messages.message_type(packet))
            self._publishers[sensor.name] = publisher, topics.sensor_frame(self._vehicle, sensor)
        collisions = self._node.publisher(
            topics.stream_topic(self._vehicle, "collision"), messages.message_type(Collision)
        )
        self._stopped = False
        context.on_stop.append(self._stop_waiting)
        deadline_s = time.monotonic() + config.wait_s
        for publisher, _ in self._publishers.values():
            while time.monotonic() < deadline_s and not self._stopped:
                if publisher.wait_for_subscribers(timeout_s=0.02):
                    break
        self._publishers["collision"] = collisions, topics.WORLD_FRAME

    def _stop_waiting(self) -> None:
        self._stopped = True
        self._node.stop_waiting()

    def write(self, packet: Packet) -> None:
        """Publish a packet if its sensor has a topic."""
        if packet.sensor in self._publishers:
            publisher, frame_id = self._publishers[packet.sensor]
            publisher.publish(self._to_message(packet, frame_id=frame_id))

    def close(self, *, complete: bool = True) -> None:
        """Deliver what is in flight, and close the topics."""
        for publisher, _ in self._publishers.values():
            publisher.close()
        self._node.close()
