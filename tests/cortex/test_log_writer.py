"""Recordings that are written without nodes."""

from __future__ import annotations

import errno
import os

import pytest
from peer import Number

from cortex.log import LogWriter, open_log
from cortex.log.sink import Sink


def test_a_message_that_cannot_be_written_leaves_no_trace(tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        for topic in ("/numbers", "/others"):
            with pytest.raises(TypeError, match=r"Number\.value"):
                log.write(topic, Number(0, "one"), 5)  # type: ignore[arg-type]
        log.write("/numbers", Number(0, 1), 10**18)
    with open_log(path) as read:
        assert [each.topic for each in read.topics] == ["/numbers"]
        ((topic, message, info),) = read.messages()
    assert (topic, message.value, info.sequence, info.log_ns) == ("/numbers", 1, 0, 10**18)


def test_a_file_whose_end_does_not_fit_is_closed(tmp_path, monkeypatch):
    """The error is that of the disk, and comes once."""
    before = len(os.listdir("/proc/self/fd"))
    log = LogWriter(tmp_path / "log.mcap")
    log.write("/numbers", Number(0, 1), 5)

    def refuse(self: Sink, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Sink, "write", refuse)
    with pytest.raises(OSError, match="No space"):
        log.close()
    log.close()
    assert len(os.listdir("/proc/self/fd")) == before
