"""Which of VMAS's scenarios record: a row of docs/pages/many-agents.md for each.

python tests/benchmarks/recorded_scenarios.py > table.md
"""

import logging
import warnings

import vmas

from pgkit.envs.vmas_batch import Vmas
from pgkit.errors import UserError


def row(name: str) -> str:
    """The scenario, and of its step and its reset whether each is recorded, or why not."""
    reasons: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: reasons.append(record.getMessage())
    logger = logging.getLogger("pgkit")
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        recorded = Vmas(name, num_envs=8, seed=1, compile="record").recorded_parts
    except (UserError, RuntimeError, AssertionError, ValueError, TypeError) as error:
        return f"| {name} | cannot be made: {str(error).splitlines()[0]} | |"
    finally:
        logger.removeHandler(handler)
    cells = [name]
    for part, words in (("advance", "the step of"), ("renew", "the resets of")):
        why = next((x for x in reasons if x.startswith(words) and "not recorded" in x), None)
        why = why or next((x for x in reasons if "not recorded" in x), "")
        cells.append("yes" if part in recorded else why.partition("as it is: ")[2])
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print("| scenario | its step | its resets |\n|---|---|---|")
    for scenario in sorted([*vmas.scenarios, *vmas.debug_scenarios, *vmas.mpe_scenarios]):
        print(row(scenario), flush=True)
