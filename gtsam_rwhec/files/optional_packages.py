"""Packages that a minimal installation does not have. If one is missing, the error names the extra that has it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import lazy_loader

from gtsam_rwhec.errors import MissingPackageError

#: The extra of this package that installs a package, by the name that ``import`` has.
EXTRAS = {
    "PIL": "log", "cv2": "log", "google": "log", "loky": "log", "lz4": "log", "mcap": "log", "mcap_protobuf": "log",
    "requests": "log", "yaml": "log", "zstandard": "log", "rosbags": "rosbags",
    "jinja2": "report", "matplotlib": "report", "plotly": "report", "rich": "report", "typer": "cli",
    "lzf": "clouds", "small_gicp": "clouds", "yourdfpy": "plan",
    "starlette": "live", "uvicorn": "live", "websockets": "live",
    "dask": "fleet", "distributed": "fleet", "fsspec": "fleet", "pyarrow": "fleet", "s3fs": "fleet",
}  # fmt: skip


@contextmanager
def extra_named() -> Iterator[None]:
    """Around an import: a missing package of an extra raises a `MissingPackageError` that names the extra.

    For imports inside functions, ``with extra_named(): import jinja2``. Modules import at their top as
    usual: names taken from a package pass through `lazy_names`.
    """
    try:
        yield
    except MissingPackageError:
        raise
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        words = f"{package} is not installed: pip install 'gtsam-rwhec[{EXTRAS[package]}]'"
        raise MissingPackageError(words, name=package) from error


def lazy_names(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`lazy_loader.attach_stub` for the names of a package, with the errors of `extra_named`."""
    attribute, names, public = lazy_loader.attach_stub(package, file)

    def attribute_or_extra(name: str) -> Any:
        with extra_named():
            return attribute(name)

    return attribute_or_extra, names, public
