"""An update on several processes, each with its share of a rollout: replicas that stay equal."""

from __future__ import annotations

from typing import Any

import torch.distributed as dist
from torch import nn

from pgkit.checks import LossView
from pgkit.checks.view import setting
from pgkit.compiled import has_compiler
from pgkit.compiled.constants import tensors_of
from pgkit.errors import UserError
from pgkit.optim import parameters
from pgkit.updates.learners import Learners
from pgkit.updates.on_policy import OnPolicyUpdate


def data_parallel(update: OnPolicyUpdate, group: Any = None) -> OnPolicyUpdate:
    r"""Makes an update one of several that train one agent: each learner calls it with its share of a rollout.

    Every learner is a process of a ``torch.distributed`` group (gloo on CPUs, nccl on GPUs) that built the same update,
    e.g. under ``torchrun``; :class:`~pgkit.updates.RayLearners` starts them by itself. A step is then the one that a
    single learner takes on the union of their minibatches:

    .. math:: g = \sum_k n_k g_k \Big/ \sum_k n_k

    with :math:`g_k` the gradient of learner :math:`k` and :math:`n_k` the rows of its minibatch that count. Metrics are
    averaged in the same all-reduce, so that all stop at the same epoch (``target_kl``). An advantage is standardized
    over the rows of all. The parameters stay equal bit for bit: all learners take the same rung of the compiler's
    ladder, and a call begins with the first learner's weights, buffers, learning rates and minibatch order.

    ``minibatch_size`` and ``total_frames`` count all learners together. What else learns from a rollout, such as an
    observation normalizer, is given everybody's: ``normalizer.update(update.learners.gather(x))``.

    Args:
        update: not called yet.
        group: the process group; None: the default one.

    Returns:
        The update itself, changed.

    Raises:
        UserError: there is no process group, another kind of update, or a minibatch that cannot be shared equally.
    """
    if not isinstance(update, OnPolicyUpdate):
        raise UserError(f"data_parallel takes an OnPolicyUpdate, this is a {type(update).__name__}")
    if not (dist.is_available() and dist.is_initialized()):
        raise UserError(
            "data_parallel needs a process group: call torch.distributed.init_process_group('gloo') in a program that "
            "torchrun started, or use updates.RayLearners(update, learners=2)"
        )
    share_minibatches(update, dist.get_world_size(group))
    view = LossView(update.loss, update.advantage)
    watched = {"the loss": update.loss, "the advantage block": update.advantage}
    held = {id(x): x for x in (*parameters(update.optimizer), *tensors_of(watched))}
    keys = _standardized_keys(update)
    update.learners = learners = Learners(list(held.values()), update.optimizer, update.generator, view, keys, group)
    if not learners.agree(has_compiler()) and update.compile == "auto":
        update.compile = "off"
    block: Any = update.advantage
    if isinstance(block, nn.Module) and setting(block, "average_gae"):
        raise UserError(f"{type(block).__name__}(average_gae=True) sees one learner's rows: use pgkit's advantages.GAE")
    if isinstance(block, nn.Module) and "standardizer" in vars(block):
        block.standardizer = learners.standardize
        block.recordable = block.recordable and not setting(block, "standardize")
    return update


def share_minibatches(update: OnPolicyUpdate, learners: int) -> None:
    """Makes the update's minibatches those of one of several learners."""
    rows = update.minibatch_size
    if rows is not None and rows % (learners * (update.sequence_length or 1)):
        of = "" if update.sequence_length is None else f" of whole sequences of {update.sequence_length} steps"
        raise UserError(f"minibatch_size={rows} cannot be shared by {learners} learners in equal parts{of}")
    update.minibatch_size = None if rows is None else rows // learners


def _standardized_keys(update: OnPolicyUpdate) -> list[Any]:
    """Entries that the loss or the update standardizes in each minibatch; from now on it does not."""
    found = [LossView(update.loss).key("advantage") or "advantage"] if update.normalize_advantage else []
    update.normalize_advantage = False
    for loss in update.loss.modules():
        if setting(loss, "normalize_advantage"):
            found.append(LossView(loss).key("advantage") or "advantage")
            loss.normalize_advantage = False
    return list(dict.fromkeys(found))
