import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread():
    """Small tensors: threads that wait for each other cost more than they do, far more on a busy machine."""
    torch.set_num_threads(1)
