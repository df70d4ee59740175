"""Replaces SGLang's CUDA kernels without a GPU: importable, but calling one is an error."""

__version__ = "0.4.10"


def __getattr__(name):
    if name.startswith("__"):
        raise AttributeError(name)

    def absent(*arguments, **options):
        raise NotImplementedError(f"sgl_kernel.{name} needs a GPU")

    return absent
