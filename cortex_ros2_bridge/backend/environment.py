"""Settings from the environment variables of ROS 2 and of Cyclone DDS."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import socket
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

from cortex_ros2_bridge.typestore import DEFAULT_DISTRO, DISTROS

_log = logging.getLogger(__name__)

_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")

# The end of a writer, of which there are many, waits a second each for a subscriber that was killed. An image
# is larger than the usual buffer of a socket: what the kernel drops is asked for again after 100 ms.
_TUNING = (
    "<Internal><WriterLingerDuration>50 ms</WriterLingerDuration>"
    '<SocketReceiveBufferSize min="default" max="4MB"/></Internal>'
)
_BEST = '<NetworkInterface autodetermine="true"/>'
_LOOPBACK = '<NetworkInterface address="127.0.0.1"/>'
_ELSEWHERE = "192.0.2.1"
"""An address of no host (RFC 5737)."""

# As ROS does it: unicast discovery on a host works only between processes with numbers.
_INDEX = "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"


def chosen_distro(option: str | None = None, environment: Mapping[str, str] = os.environ) -> str | None:
    """Return the distribution that an option or ROS_DISTRO names; None: neither does.

    Raises:
        ValueError: The option names one that is not known.
    """
    if option is not None:
        if option not in DISTROS:
            raise ValueError(f"unknown ROS distribution {option!r}, known: {', '.join(DISTROS)}")
        return option
    distro = environment.get("ROS_DISTRO") or None
    if distro is None or distro in DISTROS:
        return distro
    _log.warning("ROS_DISTRO=%s is not known; messages are those of %s", distro, DEFAULT_DISTRO)
    return DEFAULT_DISTRO


def domain_id(option: int | None = None, environment: Mapping[str, str] = os.environ) -> int:
    """Return the DDS domain: the option, ROS_DOMAIN_ID or 0.

    Raises:
        ValueError: It is not a number from 0 to 232.
    """
    name = "ROS_DOMAIN_ID" if option is None else "domain"
    text = environment.get(name, "") or "0" if option is None else str(option)
    if not text.isdecimal() or int(text) > 232:  # ports end there
        raise ValueError(f"{name} must be a number from 0 to 232, got {text!r}")
    return int(text)


def cyclone_config(distro: str | None = None, environment: Mapping[str, str] = os.environ) -> str:
    """Return the configuration of a domain, in the form of CYCLONEDDS_URI, whose settings win.

    ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS and ROS_LOCALHOST_ONLY mean what they mean to
    `rmw_cyclonedds_cpp`: Humble knows the last one only, and keeps to the interface 127.0.0.1; later ones
    search on this host only. For these the interface 127.0.0.1 is added to the one that Cyclone DDS
    chooses: nodes on Fast DDS that start later look for others there only, nodes on Cyclone DDS on the
    chosen one only.

    Raises:
        ValueError: A variable has a value that ROS does not know.
    """
    area = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() or "SUBNET"
    if area not in _RANGES:
        raise ValueError(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE must be one of {', '.join(_RANGES)}, "
            f"got {environment['ROS_AUTOMATIC_DISCOVERY_RANGE']!r}"
        )
    peers = [peer for peer in environment.get("ROS_STATIC_PEERS", "").split(";") if peer]
    theirs = environment.get("CYCLONEDDS_URI", "")
    general, discovery = "", _INDEX
    is_local = _localhost_only(environment)
    if distro is not None and DISTROS[distro].range_variable == "ROS_LOCALHOST_ONLY":
        area, peers = "SYSTEM_DEFAULT", ["localhost"] if is_local else []
        general = f"<Interfaces>{_LOOPBACK}</Interfaces>" if is_local else ""
    elif is_local:
        area, peers = "LOCALHOST", []
    if area in ("LOCALHOST", "OFF"):
        general = "<AllowMulticast>false</AllowMulticast>"
    if area == "LOCALHOST":
        general = ("" if _names_interfaces(theirs) else _both_interfaces()) + general
        peers = ["localhost", *peers]
    elif area == "OFF":
        discovery = f"<ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{os.getpid()}</Tag>"
        peers = []
    if peers:
        discovery += f"<Peers>{''.join(f'<Peer address={quoteattr(peer)}/>' for peer in peers)}</Peers>"
    ours = (
        f"<CycloneDDS><Domain>{general and f'<General>{general}</General>'}"
        f"<Discovery>{discovery}</Discovery>{_TUNING}"
        "</Domain></CycloneDDS>"
    )
    return f"{ours},{theirs}" if theirs else ours


def _both_interfaces() -> str:
    """Choose the best interface and 127.0.0.1; "" where that is the best one, or there is none.

    Cyclone DDS refuses to begin with the same interface twice.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((_ELSEWHERE, 9))  # sends nothing; the kernel says from where it would
        except OSError:
            return ""
        if probe.getsockname()[0].startswith("127."):
            return ""
    return f"<Interfaces>{_BEST}{_LOOPBACK}</Interfaces>"


def _names_interfaces(uri: str) -> bool:
    """Return whether settings of CYCLONEDDS_URI choose interfaces: ours would be added to them."""
    texts = [uri]
    for path in re.findall(r"file://([^,]+)", uri):
        with contextlib.suppress(OSError, UnicodeDecodeError):  # Cyclone DDS says what is wrong with the file
            texts.append(Path(path).read_text(encoding="utf-8"))
    return any("networkinterface" in text.lower() for text in texts)


def _localhost_only(environment: Mapping[str, str]) -> bool:
    value = environment.get("ROS_LOCALHOST_ONLY", "")
    if value not in ("", "0", "1"):
        raise ValueError(f"ROS_LOCALHOST_ONLY must be 0 or 1, got {value!r}")
    return value == "1"
