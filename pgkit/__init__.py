"""pgkit: policy-gradient building blocks on TorchRL."""
