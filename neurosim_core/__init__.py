"""Neurosim: event cameras, RGB, depth and IMU on agile multirotors.

Everything is imported on first use: `import neurosim_core` starts no device and loads no heavy library.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from neurosim_core.lazy import lazy_names

if TYPE_CHECKING:  # isort: off
    from neurosim_core import (
        control as control,
        data as data,
        io as io,
        learn as learn,
        packets as packets,
        random as random,
        registry as registry,
        scene as scene,
        sensors as sensors,
        sim as sim,
        sinks as sinks,
        vehicle as vehicle,
    )
    from neurosim_core.config import (
        SimulationConfig as SimulationConfig,
        load_config as load_config,
        to_yaml as to_yaml,
    )
    from neurosim_core.control.setpoints import (
        AttitudeThrust as AttitudeThrust,
        BodyRates as BodyRates,
        MotorSpeeds as MotorSpeeds,
        Position as Position,
        Velocity as Velocity,
    )
    from neurosim_core.flight import fly as fly
    from neurosim_core.frames import Mount as Mount
    from neurosim_core.live.messages import (
        message_type as message_type,
        to_packet as to_packet,
    )
    from neurosim_core.live.remote_renderer import (
        Frames as Frames,
        serve_frames as serve_frames,
    )
    from neurosim_core.packets import (
        Collision as Collision,
        Events as Events,
        Image as Image,
        ImuSample as ImuSample,
        Odometry as Odometry,
        Packet as Packet,
    )
    from neurosim_core.record import Recording as Recording
    from neurosim_core.registry import register as register
    from neurosim_core.render.camera import PinholeConfig as PinholeConfig
    from neurosim_core.render.conformance import check_renderer as check_renderer
    from neurosim_core.render.renderer import (
        RendererConfig as RendererConfig,
        make_renderer as make_renderer,
        upload_scene as upload_scene,
    )
    from neurosim_core.sensors.event_batch import EventCameraBatch as EventCameraBatch
    from neurosim_core.sensors.event_config import EventCameraConfig as EventCameraConfig
    from neurosim_core.sensors.events import EventCamera as EventCamera
    from neurosim_core.settings_file import ConfigError as ConfigError
    from neurosim_core.sim.model import (
        Model as Model,
        make_model as make_model,
    )
    from neurosim_core.sim.rollout import (
        run as run,
        run_model as run_model,
        step as step,
    )
    from neurosim_core.sim.simulation import Simulation as Simulation
    from neurosim_core.sim.state import (
        State as State,
        make_state as make_state,
    )
    from neurosim_core.vehicle import (
        DynamicsError as DynamicsError,
        Multirotor as Multirotor,
        MultirotorConfig as MultirotorConfig,
        preset as preset,
    )

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
