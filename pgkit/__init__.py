"""pgkit: policy-gradient building blocks on TorchRL."""

__version__ = "0.1.0"
