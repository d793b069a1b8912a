"""The one look at an assembled agent before its first step, and what a mistake is called."""

from pgkit.checks.assembly import assembly
from pgkit.checks.diagram import diagram
from pgkit.checks.keys import is_loss
from pgkit.checks.settings import check_settings
from pgkit.checks.view import LossView, device_of, result_of

__all__ = ["LossView", "assembly", "check_settings", "device_of", "diagram", "is_loss", "result_of"]
