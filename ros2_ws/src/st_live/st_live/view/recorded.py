"""The live view of a run that is over: its recording drawn as the viewer would have drawn it."""

from pathlib import Path

import rerun as rr
from rosbags.highlevel import AnyReader
from st_recordings.recorded import configuration_of
from st_recordings.runs.bag import definitions, open_bag, read_bag
from st_recordings.runs.cdr import typestore

from ..verification import recordings_of
from . import scene
from .feed import TOPICS, Feed

PERIOD_NS = 100_000_000
FLUSH = 5.0  # s; few large pieces load quickly


def draw(path: Path, file: Path, vehicle: Path | None = None) -> int:
    """Write the view of a bag, or of the bag in a folder of st, to `file` (.rrd); returns the number of pictures.

    vehicle: file to take instead of the recorded one, for the outline. Raises RunError, ConfigurationError.
    """
    bag, _ = recordings_of(path)
    open_bag(bag)
    car, recorded, _ = configuration_of(read_bag(bag).records, vehicle)
    recording = scene.recording(path.name, FLUSH, rr.FileSink(str(file)))
    feed = Feed(scene.Scene(recording, car), recorded.nodes.get("predictor", {}).get("map_frame", "map"))
    pictures, due_ns = 0, 0
    with AnyReader([bag], default_typestore=typestore(definitions())) as reader:
        wanted = [c for c in reader.connections if _topic(c.topic)]
        for connection, log_ns, data in reader.messages(connections=wanted):
            if log_ns >= due_ns:
                feed.draw()
                pictures, due_ns = pictures + 1, log_ns + PERIOD_NS
            feed.take(str(_topic(connection.topic)), reader.deserialize(data, connection.msgtype))
    feed.draw()
    recording.flush()
    recording.disconnect()
    return pictures


def _topic(name: str) -> str | None:
    """The suite's own name of a recorded topic, in whatever namespace it was."""
    return next((topic for topic in TOPICS if name == topic or name.endswith(f"/{topic.lstrip('/')}")), None)
