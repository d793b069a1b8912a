"""Files that are written whole or not at all, carry their own hash, and hold data only, no code."""

from __future__ import annotations

import contextlib
import hashlib
import os
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NoReturn

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from pgkit.errors import UserError

_MARK = b"pgkit-sha256"  # at the end of a file, before the 32 bytes of its hash
# what torch's safe loading does not take; tensors stand for them
_NUMPY, _TENSORDICT, _BYTES = "<numpy>", "<tensordict>", "<bytes>"
_PLAIN = (torch.Tensor, torch.Size, torch.device, torch.dtype, str, bool, int, float, type(None))


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A new file that takes the place of ``path`` where the block ends well: a crash leaves the old one or the new one.

    Raises:
        UserError: it cannot be written; nothing is left behind.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        part.unlink(missing_ok=True)  # of a process that was killed; a link is removed, never followed
        with open(part, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        cannot_write(path, error)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def cannot_write(path: Path, error: OSError) -> NoReturn:
    """Raises the ``UserError`` of a file that cannot be written."""
    raise UserError(f"{path} cannot be written: {error.strerror or error}") from error


def save(path: Path, content: Any) -> None:
    """Writes tensors, arrays and numbers in dicts, lists and tuples, and the hash of it all.

    Raises:
        UserError: the content holds something else, or the file cannot be written.
    """
    plain = _encode(content, path.name)
    with replacing(path) as file:
        hashed = _Hashing(file)
        try:
            torch.save(plain, hashed)
        except RuntimeError:  # torch's writer has one of its own for a write that failed
            if hashed.failed is None:
                raise
            raise hashed.failed from None
        file.write(_MARK + hashed.sha256.digest())


def load(path: Path) -> Any:
    """What :func:`save` wrote, on the CPU.

    Raises:
        UserError: the file is not there, its hash differs, or it holds code.
    """
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            if not _fits(file):
                raise UserError(f"{path} is damaged: its hash does not fit, or an earlier pgkit wrote it")
            file.seek(0)
            warnings.simplefilter("ignore")
            return _decode(torch.load(file, map_location="cpu", weights_only=True))
    except FileNotFoundError:
        raise UserError(f"{path} is not there") from None
    except UserError:
        raise
    except Exception as error:  # a reader may stumble over forged bytes in any way
        raise UserError(f"{path} is damaged: {(str(error) or repr(error)).splitlines()[0]}") from error


class _Hashing:
    """Passes on what is written, and hashes it."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file, self.sha256 = file, hashlib.sha256()
        self.failed: OSError | None = None

    def write(self, data: Any) -> int:
        self.sha256.update(data)
        try:
            return self.file.write(data)
        except OSError as error:
            self.failed = error
            raise

    def flush(self) -> None:
        self.file.flush()


def is_whole(path: Path) -> bool:
    """Whether the file is there and its hash fits."""
    try:
        with path.open("rb") as file:
            return _fits(file)
    except OSError:
        return False


def _fits(file: IO[bytes]) -> bool:
    size = file.seek(0, os.SEEK_END) - len(_MARK) - 32
    file.seek(0)
    sha256 = hashlib.sha256()
    while size > 0 and (block := file.read(min(size, 1 << 20))):
        sha256.update(block)
        size -= len(block)
    return size == 0 and file.read() == _MARK + sha256.digest()


def _encode(x: Any, where: str) -> Any:
    """``x`` in the types that torch loads without running code; where it holds others, a UserError says where."""
    if isinstance(x, np.ndarray) and x.dtype != object:
        return (_NUMPY, torch.from_numpy(np.ascontiguousarray(x)).reshape(x.shape))
    if isinstance(x, bytes):
        return (_BYTES, torch.tensor(list(x), dtype=torch.uint8))
    if isinstance(x, np.generic):
        return x.item()
    if isinstance(x, TensorDictBase):
        return (_TENSORDICT, {key: _encode(x.get(key), where) for key in x.keys(True, True)}, list(x.batch_size))
    if isinstance(x, Mapping):
        return {key: _encode(value, f"{where}, {key}") for key, value in x.items()}
    if isinstance(x, list | tuple) and not isinstance(x, torch.Size):
        items = [_encode(value, where) for value in x]
        return items if isinstance(x, list) else tuple(items)
    if isinstance(x, _PLAIN):
        return x
    raise UserError(
        f"{where} holds {x!r:.80}: files take tensors, arrays, numbers and text, in dicts, lists and tuples"
    )


def _decode(x: Any) -> Any:
    if isinstance(x, dict):
        return {key: _decode(value) for key, value in x.items()}
    if isinstance(x, tuple) and x[:1] == (_NUMPY,):
        return x[1].numpy()
    if isinstance(x, tuple) and x[:1] == (_BYTES,):
        return bytes(x[1].tolist())
    if isinstance(x, tuple) and x[:1] == (_TENSORDICT,):
        return TensorDict({key: _decode(value) for key, value in x[1].items()}, x[2])
    if isinstance(x, list | tuple) and not isinstance(x, torch.Size):
        items = [_decode(value) for value in x]
        return items if isinstance(x, list) else tuple(items)
    return x
