"""The sensors, one file for each kind; and what sensors of your own are made of."""

from __future__ import annotations

from typing import TYPE_CHECKING

from neurosim_core.lazy import lazy_names

if TYPE_CHECKING:  # isort: off
    from neurosim_core.runtime.cuda import Launches as Launches
    from neurosim_core.sensors.base import (
        FrameContext as FrameContext,
        FrameSensor as FrameSensor,
        FrameSensorConfig as FrameSensorConfig,
        ImageSensorConfig as ImageSensorConfig,
        PictureContext as PictureContext,
        PictureSensorConfig as PictureSensorConfig,
        RateHz as RateHz,
        RenderRequest as RenderRequest,
        Sampler as Sampler,
        SamplerContext as SamplerContext,
        StateSensorConfig as StateSensorConfig,
    )
    from neurosim_core.sensors.event_noise_model import (
        NoiseTermConfig as NoiseTermConfig,
        SignalTerm as SignalTerm,
    )
    from neurosim_core.sensors.kalibr import (
        read_camchain as read_camchain,
        write_camchain as write_camchain,
    )
    from neurosim_core.sensors.state_sampler import (
        ErrorConfig as ErrorConfig,
        Errors as Errors,
        LateConfig as LateConfig,
        Motion as Motion,
        Sampling as Sampling,
        StateSampler as StateSampler,
        error_adder as error_adder,
        make_errors as make_errors,
        make_reader as make_reader,
    )

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
