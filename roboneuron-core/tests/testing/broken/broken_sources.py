"""Perception sources with one fault each."""

import threading
import time
from dataclasses import replace

from roboneuron.errors import StateError
from roboneuron.testing.fakes import ControlledSource


class NoRead:
    def __init__(self, config, topics, cameras): ...
    def open(self): ...
    def close(self): ...


class OpensFile(ControlledSource):
    def __init__(self, config, topics, cameras):
        super().__init__(config, topics, cameras)
        open("/proc/self/status", "rb").close()


class SubscribesEarly(ControlledSource):
    def __init__(self, config, topics, cameras):
        super().__init__(config, topics, cameras)
        topics.subscribe("joint_states", object, print)


class CloseNeedsOpen(ControlledSource):
    def close(self):
        if not self._is_open:
            raise StateError("not open")
        super().close()


class WrongCamera(ControlledSource):
    def read(self, timeout_s):
        return replace(super().read(timeout_s), camera="somewhere")


class NoFrameId(ControlledSource):
    def read(self, timeout_s):
        return replace(super().read(timeout_s), frame_id="")


class NoStamp(ControlledSource):
    def read(self, timeout_s):
        return replace(super().read(timeout_s), stamp_ns=0)


class GoesBack(ControlledSource):
    _count = 1000

    def read(self, timeout_s):
        self._count -= 1
        return replace(super().read(timeout_s), stamp_ns=self._count)


class OneBuffer(ControlledSource):
    _buffer = None

    def read(self, timeout_s):
        frame = super().read(timeout_s)
        if self._buffer is None:
            self._buffer = frame.image
        self._buffer[:] = frame.image
        return replace(frame, image=self._buffer)


class WaitsLong(ControlledSource):
    def read(self, timeout_s):
        return super().read(max(timeout_s, 4.0))


class ReadsUnopened(ControlledSource):
    def __init__(self, config, topics, cameras):
        super().__init__(config, topics, cameras)
        self._is_open = True


class ReadsClosed(ControlledSource):
    def close(self): ...


class LeavesThread(ControlledSource):
    def open(self):
        super().open()
        threading.Thread(target=time.sleep, args=(7,), name="forgotten", daemon=True).start()
