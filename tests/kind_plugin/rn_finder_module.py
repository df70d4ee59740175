"""The module; imported by its process only."""

from sensor_msgs.msg import Image
from std_msgs.msg import UInt32

from roboneuron.feature import Module, ModuleHost


class FinderModule(Module):
    """Publishes how many images came."""

    def __init__(self, node: ModuleHost) -> None:
        super().__init__(node)
        camera = self.config.modules["finder"]["camera"]
        self._count, self._is_active = 0, False
        self._publish = node.advertise(UInt32, "found")
        node.subscribe(Image, f"camera/{camera}/image", self._on_image)

    def activate(self) -> None:
        """Count from now on."""
        self._is_active = True
        self.status.set_waiting("the first image")

    def deactivate(self) -> None:
        """Count no more."""
        self._is_active = False

    def _on_image(self, _: Image) -> None:
        if self._is_active:
            self._count += 1
            self._publish.publish(UInt32(data=self._count))
            self.status.set_ready()
