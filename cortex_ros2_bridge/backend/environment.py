"""What environment variables of ROS 2 and of Cyclone DDS ask for."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
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
    `rmw_cyclonedds_cpp`: Humble keeps to the interface 127.0.0.1, later ones search on this host only.

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
    general, discovery = "", _INDEX
    if _localhost_only(environment):
        if distro in (None, "humble"):
            general = '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
            area, peers = "SYSTEM_DEFAULT", ["localhost"]
        else:
            area, peers = "LOCALHOST", []
    if area in ("LOCALHOST", "OFF"):
        general = "<AllowMulticast>false</AllowMulticast>"
    if area == "LOCALHOST":
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
    theirs = environment.get("CYCLONEDDS_URI", "")
    return f"{ours},{theirs}" if theirs else ours


def _localhost_only(environment: Mapping[str, str]) -> bool:
    value = environment.get("ROS_LOCALHOST_ONLY", "")
    if value not in ("", "0", "1"):
        raise ValueError(f"ROS_LOCALHOST_ONLY must be 0 or 1, got {value!r}")
    return value == "1"
