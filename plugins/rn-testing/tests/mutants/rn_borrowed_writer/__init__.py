"""A feature that uses the publisher of the direct path."""

from roboneuron import Feature, Host


class Borrower(Feature[None]):
    def start(self, host: Host) -> None:
        from roboneuron.direct_path import writer

        assert writer.TopicWriter
