"""Runtimes and accelerations with one fault each."""

import threading
import time

from roboneuron.errors import StateError
from roboneuron.testing.fakes import CountingRuntime, HalvingAcceleration


class NoAbort:
    def __init__(self, config): ...
    def load(self, model, acceleration=None): ...
    def run(self, request): ...
    def close(self): ...


class OpensFile(CountingRuntime):
    def __init__(self, config):
        super().__init__(config)
        open("/proc/self/status", "rb").close()


class CloseNeedsLoad(CountingRuntime):
    def close(self):
        if self._decoder is None:
            raise StateError("not loaded")
        super().close()


class AnswersNothing(CountingRuntime):
    def run(self, request):
        super().run(request)


class RunsAlways(CountingRuntime):
    def run(self, request):
        return 4


class NeverCloses(CountingRuntime):
    def close(self): ...


class RefusesAcceleration(CountingRuntime):
    def load(self, model):
        super().load(model)


class AbortHangs(CountingRuntime):
    def abort(self):
        time.sleep(8)


class LeavesThread(CountingRuntime):
    def load(self, model, acceleration=None):
        super().load(model, acceleration)
        threading.Thread(target=time.sleep, args=(7,), name="forgotten", daemon=True).start()


class NoApply:
    def __init__(self, config): ...


class PresetOpensFile(HalvingAcceleration):
    def __init__(self, config):
        super().__init__(config)
        open("/proc/self/status", "rb").close()


class ApplyFails(HalvingAcceleration):
    def apply(self, decoder):
        raise RuntimeError("no")


class AppliesOnce(HalvingAcceleration):
    def apply(self, decoder):
        super().apply(decoder)
        del self._kept_fraction


class AppliesToAnything(HalvingAcceleration):
    def apply(self, decoder): ...
