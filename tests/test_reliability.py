"""The reliability page says what the fault tests say."""

from pathlib import Path

import pytest

from tests import reliability


def test_the_page_is_what_the_fault_tests_say():
    assert reliability.PAGE.read_text(encoding="utf-8") == reliability.page(reliability.faults()), (
        "write it again: python tests/reliability.py"
    )


def test_every_fault_has_one_of_the_kinds_and_says_what_comes_of_it():
    for fault in reliability.faults():
        assert fault.kind in reliability.KINDS and fault.injected and fault.outcome
        assert "|" not in fault.injected + fault.outcome


def test_markers_are_read_without_running_the_tests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(reliability, "TESTS", tmp_path)
    (tmp_path / "test_x.py").write_text(
        "@pytest.mark.fault(kind=3, injected='an ' 'outlier', outcome='nothing')\ndef test_outlier(): raise Exception\n"
    )
    found = reliability.faults()
    assert found == [reliability.Fault(3, "an outlier", "nothing", "test_outlier")]
    assert "### Outliers\n\n| injected" in reliability.page(found) and "`test_outlier`" in reliability.page(found)
