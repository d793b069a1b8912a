"""Scalars for TensorBoard, written in this thread to one file whose name the run knows."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path
from typing import Any


class Board:
    """Appends scalars to a new event file.

    Args:
        run_dir: the folder.
        identity: ends the file's name.
        upto: the steps after it, of an earlier file, are not shown.
    """

    def __init__(self, run_dir: Path, identity: str, upto: int = 0) -> None:
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._event, self._summary = Event, Summary
        now = time.time_ns()
        name = f"events.out.tfevents.{now // 10**9}.{socket.gethostname()}.{os.getpid()}.{now % 10**9}.{identity}"
        self._file: Any = RecordWriter((run_dir / name).open("xb"))
        self._write(file_version="brain.Event:2")
        if upto:
            self._write(step=upto + 1, session_log=SessionLog(status=SessionLog.START))

    def add(self, name: str, value: Any, step: int) -> None:
        """One scalar."""
        self._write(step=step, summary=self._summary(value=[self._summary.Value(tag=name, simple_value=float(value))]))

    def _write(self, **content: Any) -> None:
        self._file.write(self._event(wall_time=time.time(), **content).SerializeToString())

    def flush(self) -> None:
        """Hands what was added to the system."""
        self._file.flush()

    def close(self) -> None:
        """Ends the file."""
        self._file.close()
