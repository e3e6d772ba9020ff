"""Recording topics into MCAP files, reading the files, and playing them back.

    with Node("recorder") as node, Recorder(node, "run.mcap"):      # all topics
        time.sleep(10.0)

    with open_log("run.mcap") as log:
        for topic, message, info in log.messages(["/scan"]):
            ...

    with Node("player") as node, open_log("run.mcap") as log:
        Player(node, log).run(rate=0.5)

A file explains itself: every channel has the structure of its type. It needs the library `mcap`
(`pip install mcap`).
"""

from cortex.log.format import LogError, LogInfo, LogTopic
from cortex.log.player import Player
from cortex.log.reader import Log, open_log
from cortex.log.recorder import Recorder, RecordStats, TopicStats
from cortex.log.writer import LogWriter

__all__ = [
    "Log",
    "LogError",
    "LogInfo",
    "LogTopic",
    "LogWriter",
    "Player",
    "RecordStats",
    "Recorder",
    "TopicStats",
    "open_log",
]
