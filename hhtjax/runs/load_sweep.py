"""`load_sweep`: reads what a sweep has written to disk, completely or on demand."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hhtjax.runs.storage import INPUTS, MANIFEST, NUMBER, is_chunk, read_manifest
from hhtjax.runs.zarr_store import zarr_arrays


def load_sweep(folder: str | Path, *, lazy: bool = False) -> dict[str, Any]:
    """The arrays that `sweep_to_disk` or `map_to_disk` wrote, by name, with members first.

    Args:
        folder: the folder that was written.
        lazy: whether arrays stay on disk, for results larger than memory: `x[10:20]` reads the files of these members,
            `numpy.asarray(x)` all of them.

    Returns:
        Arrays by name; for a sweep the leaves of the `Solution`: "t", "q", "v", "dt", "failure.step", ... Their first
        axis counts the members. Arrays whose length differs between chunks, such as the steps of `adaptive`, are padded
        with NaN.

    Raises:
        FileNotFoundError: the folder holds no sweep, or a chunk is missing because the sweep is not finished.
        ValueError: a file is damaged, or belongs to another chunk.

    >>> import hhtjax
    >>> hhtjax.load_sweep("no such folder")  # doctest: +IGNORE_EXCEPTION_DETAIL
    Traceback (most recent call last):
    FileNotFoundError: ...
    """
    folder = Path(folder)
    if (folder / "zarr.json").is_file():
        return zarr_arrays(folder, lazy)
    manifest = read_manifest(folder / MANIFEST) if (folder / MANIFEST).is_file() else None
    if manifest is None:
        raise FileNotFoundError(f"load_sweep: `folder` must hold a sweep; received {folder}, without a {MANIFEST}.")
    if not all(isinstance(manifest.get(key), int) for key in ("chunks", "chunk", "members")):
        raise ValueError(f"load_sweep: {folder / MANIFEST} is damaged: run the sweep again in another folder.")
    files = _Files(folder, manifest)
    missing = [path.name for path in files.paths if not path.exists()]
    if missing:
        raise FileNotFoundError(
            f"load_sweep: {len(missing)} of {len(files.paths)} chunks are missing in {folder}, the first is "
            f"{missing[0]}: repeat the call that wrote it, which continues where it stopped."
        )
    return files.arrays() if lazy else files.all()


class _Files:
    """The files of a folder."""

    def __init__(self, folder: Path, manifest: dict[str, Any]):
        self.manifest = manifest
        self.paths = [folder / f"chunk-{k:05d}.npz" for k in range(manifest.get("chunks") or 0)]

    def read(self, k: int, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """The arrays of a chunk with these names."""
        path = self.paths[k]
        try:
            with open(path, "rb") as file, np.load(file) as part:
                if not is_chunk(part, k, self.manifest.get("inputs")):
                    raise ValueError("it belongs to another chunk or another sweep")
                wanted = [name for name in part.files if name not in (NUMBER, INPUTS)] if names is None else names
                return {name: part[name] for name in wanted}
        except (ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"load_sweep: {path} is damaged ({error}): repeat the call that wrote it, which writes the file again."
            ) from error

    def all(self) -> dict[str, np.ndarray]:
        """The arrays of all members, each file read once."""
        parts = [self.read(k) for k in range(len(self.paths))]
        for name in self.manifest.get("shortened") or ():
            longest = max(part[name].shape[-1] for part in parts)
            for part in parts:
                x = part[name]
                missing = [(0, 0)] * (x.ndim - 1) + [(0, longest - x.shape[-1])]
                part[name] = np.pad(x, missing, constant_values=np.nan)
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def arrays(self) -> dict[str, StoredArray]:
        """The arrays of all members."""
        first = self.read(0)
        ragged = self.manifest.get("shortened") or ()
        return {name: StoredArray(self, name, x.shape[1:], x.dtype, name in ragged) for name, x in first.items()}


class StoredArray:
    """An array in the files of a sweep: `x[3]`, `x[10:20]`, `numpy.asarray(x)` read it on demand.

    Attributes:
        shape, dtype, ndim: as for an array of NumPy; the first axis counts the members.
    """

    def __init__(self, files: _Files, name: str, row: tuple[int, ...], dtype: np.dtype, is_ragged: bool):
        self._files, self._name, self._row, self._is_ragged = files, name, row, is_ragged
        self.dtype = dtype

    @cached_property
    def shape(self) -> tuple[int, ...]:
        row = self._row
        if self._is_ragged:
            ends = [self._files.read(k, [self._name])[self._name].shape[-1] for k in range(len(self._files.paths))]
            row = (*row[:-1], max(ends))
        return self._files.manifest["members"], *row

    @property
    def ndim(self) -> int:
        return len(self._row) + 1

    def __len__(self) -> int:
        return self._files.manifest["members"]

    def __repr__(self) -> str:
        return f"<array {self._name!r} on disk, {self.shape} {self.dtype}>"

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: Any) -> np.ndarray:
        first, *rest = index if isinstance(index, tuple) and index else (index,)
        simple = isinstance(first, (int, np.integer, slice)) or (np.ndim(first) == 1 and np.size(first) and not rest)
        if not simple or not all(isinstance(x, (int, np.integer, slice)) or x is ... for x in rest):
            return self[:][index]
        members = np.arange(len(self))[first]
        found = self._of(np.atleast_1d(members))
        return found[(slice(None), *rest)] if np.ndim(members) else found[0][tuple(rest)]

    def _of(self, members: np.ndarray) -> np.ndarray:
        length = self._files.manifest["chunk"]
        found = np.full((len(members), *self.shape[1:]), np.nan if self._is_ragged else 0, self.dtype)
        chunks = members // length
        for k in np.unique(chunks):
            here = chunks == k
            part = self._files.read(int(k), [self._name])[self._name][members[here] - k * length]
            found[(here, *(slice(n) for n in part.shape[1:]))] = part
        return found
