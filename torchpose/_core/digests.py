"""Make digests of values and files, by which kept results are told apart."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from torch import Tensor


def digest_of(parts: Iterable[str | bytes | Tensor]) -> str:
    """Return SHA-256 of texts, bytes and the numbers of tensors, one after the other."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            part = part.detach().cpu().contiguous().numpy().tobytes()
        digest.update(part.encode() if isinstance(part, str) else part)
    return digest.hexdigest()


def digest_of_files(parts: Iterable[str | Path]) -> str:
    """Return SHA-256 of texts and the contents of files, one after the other.

    Raises:
        OSError: a file cannot be read.
    """
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            digest.update(part.encode())
        else:
            with part.open("rb") as stream:
                hashlib.file_digest(stream, lambda: digest)
    return digest.hexdigest()
