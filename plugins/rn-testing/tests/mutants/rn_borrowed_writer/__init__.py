"""A feature that takes the publisher of the direct path for itself."""

from roboneuron import Feature, Host


class Borrower(Feature[None]):
    def start(self, host: Host) -> None:
        from rn_standard.direct_path import writer

        assert writer.TopicWriter
