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

from cortex.log.format import LogError as LogError
from cortex.log.format import LogInfo as LogInfo
from cortex.log.format import LogTopic as LogTopic
from cortex.log.player import Player as Player
from cortex.log.reader import Log as Log
from cortex.log.reader import open_log as open_log
from cortex.log.recorder import Recorder as Recorder
from cortex.log.recorder import RecordStats as RecordStats
from cortex.log.recorder import TopicStats as TopicStats
from cortex.log.writer import LogWriter as LogWriter
