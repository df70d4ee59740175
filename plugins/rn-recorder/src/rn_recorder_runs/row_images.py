"""Images of a run's rows, in the order of the rows."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rn_recorder_runs.episodes import stamp_of
from rn_recorder_runs.files import Record, read_records
from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.lerobot_meta import ExportSource
from rn_recorder_runs.reading import RecordDecoder, camera_of


def row_images(source: ExportSource) -> Iterator[dict[str, NDArray[np.uint8]]]:
    """Yield the images by camera for each row of each episode, uint8 (H, W, 3) RGB.

    One pass through the files; an image is kept undecoded until the last row that needs it.
    """
    rows = deque(
        {camera: row.images[camera] for camera in source.cameras}
        for episode in source.episodes
        for row in episode.rows
    )
    needed = {camera: Counter(row[camera] for row in rows) for camera in source.cameras}
    held: dict[str, dict[int, Record]] = {camera: {} for camera in source.cameras}
    decoder = RecordDecoder()
    for path in source.run.files:
        for record in read_records(path, decoder.definitions):
            camera = camera_of(record.topic)
            if camera not in needed or not needed[camera][stamp_of(record.data)]:
                continue
            held[camera].setdefault(stamp_of(record.data), record)
            while rows and all(stamp_ns in held[name] for name, stamp_ns in rows[0].items()):
                row = rows.popleft()
                found = {name: held[name][stamp_ns] for name, stamp_ns in row.items()}
                yield {
                    name: pixels_of(decoder.decode(record), record.type)
                    for name, record in found.items()
                }
                for name, stamp_ns in row.items():
                    needed[name][stamp_ns] -= 1
                    if not needed[name][stamp_ns]:
                        del held[name][stamp_ns]
    assert not rows, "all images were there when the episodes were chosen"
