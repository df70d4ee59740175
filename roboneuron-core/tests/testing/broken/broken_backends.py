"""Backends with one fault each; everything else is the instant backend's."""

import threading
import time
from dataclasses import replace

import numpy as np

from roboneuron.contract import ActionChunk
from roboneuron.errors import StateError
from roboneuron.testing.fakes import InstantBackend


class NoReset:
    def __init__(self, config, runtime=None, acceleration=None): ...
    def load(self): ...
    def predict(self, observation): ...
    def close(self): ...


class OpensFile(InstantBackend):
    def __init__(self, config, runtime=None, acceleration=None):
        super().__init__(config)
        with open("/proc/self/status", "rb") as file:
            file.read()


class StartsThread(InstantBackend):
    def __init__(self, config, runtime=None, acceleration=None):
        super().__init__(config)
        threading.Thread(target=time.sleep, args=(7,), daemon=True).start()


class Computes(InstantBackend):
    def __init__(self, config, runtime=None, acceleration=None):
        super().__init__(config)
        while not self._is_done():
            pass

    def _is_done(self):
        self._until = getattr(self, "_until", time.thread_time() + 0.6)
        return time.thread_time() > self._until


class CloseNeedsLoad(InstantBackend):
    def close(self):
        if not self._loaded:
            raise StateError("not loaded")
        super().close()


class TooLong(InstantBackend):
    def predict(self, observation):
        chunk = super().predict(observation)
        return replace(chunk, actions=np.repeat(chunk.actions, 99, axis=0))


class ReturnsArray(InstantBackend):
    def predict(self, observation):
        return super().predict(observation).actions


class UsesUndeclared(InstantBackend):
    def predict(self, observation):
        observation.frames["wrist"]
        return super().predict(observation)


class TextMetrics(InstantBackend):
    def predict(self, observation):
        return replace(super().predict(observation), metrics={"state": "fine"})


class ResetBreaks(InstantBackend):
    def reset(self):
        self._loaded = False


class LeavesThread(InstantBackend):
    def load(self):
        super().load()
        threading.Thread(target=time.sleep, args=(7,), name="forgotten", daemon=True).start()


class PredictsUnloaded(InstantBackend):
    def predict(self, observation):
        loaded, self._loaded = self._loaded, True
        try:
            return super().predict(observation)
        finally:
            self._loaded = loaded


class PredictsClosed(InstantBackend):
    def close(self): ...


class Blind(InstantBackend):
    def predict(self, observation):
        if not self._loaded:
            raise StateError("not loaded")
        return ActionChunk(actions=np.zeros((1, 7)), step_s=0.1)


class Crashes(InstantBackend):
    def predict(self, observation):
        observation.frames["primary"]
        return super().predict(observation)


class PaintsInput(InstantBackend):
    def predict(self, observation):
        chunk = super().predict(observation)
        observation.frames["primary"].image[:] = 0
        return chunk
