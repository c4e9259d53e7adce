"""Results of many members in a folder, one file for each chunk; many processes may write at the same time.

A file is complete or does not exist. It contains its number and the hash of its inputs, so that files cannot be
confused.
"""

from __future__ import annotations

import json
import os
import uuid
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

MANIFEST = "manifest.json"
NUMBER, INPUTS = "chunk.number", "chunk.inputs"  # in a file, beside the arrays


class Names(NamedTuple):
    """The layout of the arrays of a chunk. shortened, by: arrays whose last axis is cut to the largest number in
    another array."""

    all: tuple[str, ...]
    shortened: tuple[str, ...] = ()
    by: str | None = None

    def given(self, arrays: Sequence[np.ndarray], kept: int) -> dict[str, np.ndarray]:
        """The arrays of the first members, by name."""
        found = {name: x[:kept] for name, x in zip(self.all, arrays, strict=True)}
        if self.by is not None:
            longest = int(np.max(found[self.by], initial=0))
            found |= {name: found[name][..., :longest] for name in self.shortened}
        return found


class Npz(NamedTuple):
    """A folder of files of NumPy. inputs: the hash of the inputs of the members."""

    caller: str
    folder: Path
    inputs: str
    names: Names

    def path(self, k: int) -> Path:
        """The path of a chunk."""
        return self.folder / f"chunk-{k:05d}.npz"

    def holds(self, k: int) -> bool:
        """Whether the file of a chunk exists, is intact by its checksums, and belongs to this chunk."""
        try:
            with zipfile.ZipFile(self.path(k)) as file:
                if file.testzip() is not None:
                    return False
            with np.load(self.path(k)) as part:
                return is_chunk(part, k, self.inputs)
        except (OSError, ValueError, zipfile.BadZipFile):
            return False

    def left(self, chunks: int) -> list[int]:
        """The chunks that are missing."""
        return [k for k in range(chunks) if not self.holds(k)]

    def missing(self, these: Sequence[int]) -> list[int]:
        """Those of the written chunks that are not in the folder."""
        return [k for k in these if not self.path(k).exists()]

    def write(self, k: int, kept: int, arrays: Sequence[np.ndarray]):
        """Writes a chunk. If another process has written it meanwhile, its file is replaced by an equal one."""
        marks: dict[str, Any] = {NUMBER: np.asarray(k), INPUTS: np.asarray(self.inputs)}
        named = self.names.given(arrays, kept)
        write_whole(self.caller, self.path(k), lambda file: np.savez(file, **named, **marks))

    def begin(self, manifest: dict[str, Any]):
        """Writes the manifest, or compares it with the existing one."""
        path = self.folder / MANIFEST
        if not path.exists():
            stray = sorted(self.folder.glob("chunk-*.npz"))
            if stray and not path.exists():  # by now another caller may have begun
                raise ValueError(
                    f"{self.caller}: `folder` {self.folder} holds {stray[0].name}, but no {MANIFEST} that says to "
                    "which sweep it belongs. Nothing was changed there: choose another folder, or empty it."
                )
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(self.caller, path, lambda file: file.write(json.dumps(manifest, indent=1).encode() + b"\n"))
            return
        require_same(self.caller, self.folder, read_manifest(path), manifest)

    def end(self):
        """Removes temporary files of workers that died."""
        for path in self.folder.glob(".*.part"):
            path.unlink(missing_ok=True)


def require_same(caller: str, folder: Path, found: Mapping[str, Any], manifest: dict[str, Any]):
    """Raises an error unless the folder was started with the same inputs and versions."""
    if differ := [key for key in manifest if found.get(key) != manifest[key]]:
        raise ValueError(
            f"{caller}: `folder` {folder} holds another sweep, whose {', '.join(differ)} differ. Nothing was "
            "changed there: choose another folder, or the inputs of that sweep."
        )


def write_whole(caller: str, path: Path, fill: Callable[[Any], Any]):
    """Writes a file so that it is complete, also after a power failure, or does not exist."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.part")
    try:
        with open(temporary, "wb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        if os.name == "posix":
            descriptor = os.open(path.parent, os.O_RDONLY)
            os.fsync(descriptor)
            os.close(descriptor)
    except FileNotFoundError as error:
        if not path.exists():  # else another writer was done, and its caller has tidied up
            raise FileNotFoundError(
                error.errno, f"{caller}: {path} cannot be written: the folder must exist, for workers too"
            ) from error
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(
            error.errno,
            f"{caller}: {path} could not be written ({error.strerror}); earlier files are complete: "
            "free some space, and repeat the call, which continues where it stopped",
        ) from error


def is_chunk(part: Mapping[str, np.ndarray], k: int, inputs: str | None) -> bool:
    """Whether a file identifies itself as this chunk of this sweep."""
    return NUMBER in part and int(part[NUMBER]) == k and str(part[INPUTS]) == inputs


def read_manifest(path: Path) -> dict[str, Any]:
    """The contents of a manifest; empty if it is damaged."""
    try:
        found = json.loads(path.read_text())
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
