"""Write the packets of a flight with your own sink: poses in the format of TUM, beside the recording.

It prints the number of poses; `path: {kind: poses, file: poses.txt, format: tum}` flies them again. To
install such a sink as a package, name its module in an entry point of the group `neurosim.plugins`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import neurosim_core as ns


@ns.register("sink", "tum")
class TumSinkConfig(ns.sinks.SinkConfig):
    """Writes poses of the vehicle as text, one per line: t x y z qx qy qz qw."""

    kind: Literal["tum"] = "tum"
    name: str = "poses.txt"
    """Name of the file."""

    def open(self, context: ns.sinks.SinkContext) -> TumSink:
        """Return the writer of one flight."""
        return TumSink(context.folder / self.name)


class TumSink:
    """Writes each packet of odometry as a line."""

    def __init__(self, file: Path) -> None:
        self._file = file.open("w", encoding="utf-8")

    def write(self, packet: ns.Packet) -> None:
        """Take a packet of any sensor."""
        if isinstance(packet, ns.Odometry):
            numbers = [1e-9 * packet.stamp_ns, *packet.position, *packet.orientation]
            self._file.write(" ".join(f"{number:.9f}" for number in numbers) + "\n")

    def close(self, *, complete: bool = True) -> None:
        """Complete the file."""
        self._file.close()


def main(out: Path = Path("poses")) -> int:
    """Fly a circle; return how many poses were written."""
    config = {
        "device": "cpu",
        "duration_s": 1.0,
        "scene": {"rooms": 1},
        "path": {"kind": "circle"},
        "sensors": {"odometry": {"kind": "odometry", "rate_hz": 100.0}},
        "sinks+": {"poses": {"kind": "tum"}},
    }
    ns.fly(ns.load_config(config), out)
    lines = (out / "poses.txt").read_text(encoding="utf-8").splitlines()
    print(f"{len(lines)} poses, the last at {lines[-1].split()[0]} s")
    return len(lines)


if __name__ == "__main__":
    main()
