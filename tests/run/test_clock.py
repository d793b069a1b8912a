from pgkit.run.clock import Clock
from pgkit.run.metrics import warm


class Now:
    def __init__(self) -> None:
        self.t = 100.0

    def __call__(self) -> float:
        return self.t


def test_fps_leaves_out_pauses_and_compilation():
    now = Now()
    clock = Clock(now)
    now.t += 7  # building the env: not training
    clock.restart(0)
    now.t += 10  # of which 6 compiling
    assert clock.fps(400, compile_seconds=6.0) == 400 / 4
    with clock.paused():
        now.t += 50
    now.t += 2
    assert clock.fps(1000, compile_seconds=6.0) == 600 / 2
    now.t += 3
    assert clock.fps(1600, compile_seconds=7.0) == 600 / 2
    assert clock.wall == 7 + 10 + 50 + 2 + 3


def test_a_resumed_clock_counts_on_but_its_first_fps_does_not():
    now = Now()
    clock = Clock(now, already=1000.0)
    clock.restart(5000)
    now.t += 4
    assert clock.wall == 1004
    assert clock.fps(5400) == 100


def test_fps_is_nan_when_no_time_has_passed():
    clock = Clock(Now())
    clock.restart(0)
    assert clock.fps(10) != clock.fps(10)


def test_warm_drops_two_rows_or_a_tenth_but_never_all():
    assert warm([1.0]) == [1.0]
    assert warm([1.0, 2.0]) == [2.0]
    assert warm([1.0, 2.0, 3.0]) == [3.0]
    assert warm([float(i) for i in range(40)])[0] == 4.0
