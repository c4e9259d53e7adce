"""Results of many members as one Zarr store with named dimensions, which xarray can open; many processes may write to
it."""

from __future__ import annotations

import os
import shutil
import uuid
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hhtjax.runs.storage import Names, require_same

ATTRIBUTE = "hhtjax"  # of the group: the manifest
WRITTEN = "chunk_written"  # an array beside the others: which chunks are there


class Zarr(NamedTuple):
    """A Zarr store. dims: names of the axes of each array after the axis of members."""

    caller: str
    folder: Path
    inputs: str
    names: Names
    dims: tuple[tuple[str, ...], ...]
    length: int

    def left(self, chunks: int) -> list[int]:
        """The chunks that are missing."""
        written = np.asarray(open_zarr(self.caller, self.folder)[WRITTEN][:])
        return [k for k in range(chunks) if not written[k]]

    def missing(self, these: Sequence[int]) -> list[int]:
        """Those of the written chunks that are not in the store."""
        return sorted(set(these) & set(self.left(max(these) + 1)))

    def write(self, k: int, kept: int, arrays: Sequence[np.ndarray]):
        """Writes the arrays of a chunk, and then the flag that they exist."""
        group, start = open_zarr(self.caller, self.folder, "r+"), k * self.length
        try:
            for name, x in zip(self.names.all, arrays, strict=True):
                group[name][start : start + kept] = x[:kept]
            group[WRITTEN][k] = True
        except OSError as error:
            raise OSError(
                error.errno,
                f"{self.caller}: chunk {k} could not be written to {self.folder} ({error.strerror}); earlier ones "
                "are complete: free some space, and repeat the call, which continues where it stopped",
            ) from error

    def begin(self, manifest: dict[str, Any], like: Sequence[Any]):
        """Creates the arrays, or compares the manifest with the existing one."""
        if (self.folder / "zarr.json").exists():
            found = open_zarr(self.caller, self.folder).attrs.get(ATTRIBUTE) or {}
            return require_same(self.caller, self.folder, found, manifest)
        if self.folder.exists() and any(self.folder.iterdir()):
            raise ValueError(
                f"{self.caller}: `folder` {self.folder} must be empty, or hold this sweep as a Zarr store."
            )
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        making = self.folder.with_name(f".{self.folder.name}.{uuid.uuid4().hex[:12]}.part")
        group = open_zarr(self.caller, making, "w")
        for name, x, dims in zip(self.names.all, like, self.dims, strict=True):
            row = x.shape[1:]
            array = group.create_array(
                name,
                shape=(manifest["members"], *row),
                chunks=(self.length, *(max(n, 1) for n in row)),
                dtype=x.dtype,
                dimension_names=("member", *dims),
                fill_value=np.nan if np.issubdtype(x.dtype, np.floating) else 0,
            )
            if name in ("t", "dt"):
                array.attrs["units"] = "s"
            elif "sample" in dims:
                array.attrs["coordinates"] = "t"
        group.create_array(
            WRITTEN, shape=(manifest["chunks"],), chunks=(1,), dtype=bool, dimension_names=("chunk",), fill_value=False
        )
        group.attrs[ATTRIBUTE] = manifest
        _consolidate(group)
        try:
            os.replace(making, self.folder)
        except OSError:  # another caller was faster
            shutil.rmtree(making)
            if not (self.folder / "zarr.json").exists():
                raise
            self.begin(manifest, like)

    def end(self):
        """Nothing to do: no temporary files exist."""


def _consolidate(group: Any):
    """Collects all metadata in one file, which xarray looks for. Zarr warns that this is not yet part of its format
    3."""
    import zarr

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata")
        zarr.consolidate_metadata(group.store)


def open_zarr(caller: str, folder: Path, mode: Any = "r") -> Any:
    """The group of a store."""
    try:
        import zarr
    except ImportError:
        raise ImportError(
            f"{caller}: a Zarr store needs the package zarr: pip install 'hhtjax[cluster]'; or leave out format=."
        ) from None
    return zarr.open_group(folder, mode=mode, zarr_format=3)


def zarr_arrays(folder: Path, lazy: bool) -> dict[str, Any]:
    """The contents of a Zarr store that this library wrote."""
    group = open_zarr("load_sweep", folder)
    written = np.asarray(group[WRITTEN][:])
    if not written.all():
        raise FileNotFoundError(
            f"load_sweep: {np.sum(~written)} of {len(written)} chunks are missing in {folder}, the first is number "
            f"{int(np.argmin(written))}: repeat the call that wrote it, which continues where it stopped."
        )
    arrays = {name: x for name, x in group.arrays() if name != WRITTEN}
    return arrays if lazy else {name: x[:] for name, x in arrays.items()}
