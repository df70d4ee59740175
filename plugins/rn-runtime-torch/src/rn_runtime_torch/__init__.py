"""In-process execution of VLA decoders with PyTorch."""
