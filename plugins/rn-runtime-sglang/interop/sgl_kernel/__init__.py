"""Stands in for SGLang's CUDA kernels where there is no GPU: importable, and an error when one is
really called.
"""

__version__ = "0.4.10"


def __getattr__(name):
    if name.startswith("__"):
        raise AttributeError(name)

    def absent(*arguments, **options):
        raise NotImplementedError(f"sgl_kernel.{name} needs a GPU")

    return absent
