"""Memory that somebody else has mapped, pinned, so that a CUDA device copies into it by itself.

A copy to memory that is not pinned holds up the host until it is done, and goes through memory of the
driver's. What Warp allocates can be pinned by Warp; shared memory, which others have mapped, only by CUDA.
"""

from __future__ import annotations

import ctypes
import functools
import logging
from typing import Any, ClassVar

import numpy as np
import warp as wp

_logger = logging.getLogger(__name__)
_PORTABLE = 1
"""Pinned for every context: `CU_MEMHOSTREGISTER_PORTABLE`."""


class PinError(RuntimeError):
    """CUDA cannot pin this memory; the message has its error code."""


class PinnedMapping:
    """A mapping that is pinned until `close`, and is kept mapped until then.

    Attributes:
        made_count: How many there have been in this process. An address may be that of an earlier mapping: a
            graph that copies to it may only be replayed if no mapping was made since it was recorded.
        memory: The mapping.
    """

    made_count: ClassVar[int] = 0

    def __init__(self, memory: Any, device: Any) -> None:
        """Pin all of a mapping such as an `mmap`, to read and write, for a CUDA device.

        Raises:
            PinError: That is not possible.
        """
        self.memory = memory
        self._device = wp.get_device(device)
        self._bytes: Any = np.frombuffer(memory, np.uint8)
        with wp.ScopedDevice(self._device):
            code = _driver().cuMemHostRegister_v2(self._address, ctypes.c_size_t(self._bytes.size), _PORTABLE)
        if code:
            self._bytes = self.memory = None
            raise PinError(f"CUDA error {code}")
        PinnedMapping.made_count += 1

    @property
    def _address(self) -> ctypes.c_void_p:
        return ctypes.c_void_p(self._bytes.ctypes.data)

    def close(self) -> None:
        """Wait for copies that are under way, unpin the mapping, and let go of it; again: does nothing."""
        if self.memory is None:
            return
        try:
            with wp.ScopedDevice(self._device):
                try:
                    wp.synchronize_device(self._device)
                finally:
                    code = _driver().cuMemHostUnregister(self._address)
            if code:
                _logger.warning("shared memory stays pinned: CUDA error %d", code)
        finally:
            self._bytes = self.memory = None


@functools.cache
def _driver() -> Any:
    """Return the library of CUDA's driver.

    Raises:
        PinError: There is none.
    """
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise PinError(str(error)) from None
