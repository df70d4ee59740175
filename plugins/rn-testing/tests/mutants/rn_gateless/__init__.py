"""A feature that would publish around the gate."""

from broken_features import Good


class Gateless(Good):
    """Looks harmless."""

    def start(self, host: object) -> None:
        import rclpy

        rclpy.create_node("gateless")
