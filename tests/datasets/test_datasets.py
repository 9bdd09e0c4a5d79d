"""Downloading the real dataset, from a server on this machine that serves the real files."""

from __future__ import annotations

import hashlib
import http.server
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from places import DATA, script
from web_server import served

import gtsam_rwhec as rw
from gtsam_rwhec.datasets import UTIAS_URL, fetch_utias, utias_files
from gtsam_rwhec.errors import FetchError


class CountingHandler(http.server.SimpleHTTPRequestHandler):
    """Serves a folder, remembers what was asked for, and answers with errors when told to."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # or each answer waits 40 ms for the client's acknowledgement of its header
    requested: list[str]
    answers: list[int]

    def do_GET(self) -> None:
        self.requested.append(self.path.removeprefix("/"))
        if self.answers:
            self.send_response(self.answers.pop(0))
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        super().do_GET()

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


@dataclass
class Server:
    """An HTTP server on this machine; `answers` is a list of statuses for its next answers."""

    url: str
    requested: list[str]
    answers: list[int]


@contextmanager
def serving(folder: Path) -> Iterator[Server]:
    """Serve a folder."""
    kept: dict[str, list[Any]] = {"requested": [], "answers": []}
    with served(partial(type("Handler", (CountingHandler,), kept), directory=str(folder))) as address:
        yield Server(f"{address}/", **kept)


@pytest.fixture
def server(utias_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """Serves the real dataset's folder."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with serving(utias_folder) as running:
        yield running


@pytest.fixture
def spoilt(utias_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Server, Path]]:
    """Serves a copy of the dataset, whose folder a test may spoil."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    folder = Path(shutil.copytree(utias_folder, tmp_path / "served"))
    folder.chmod(0o755)
    for path in folder.iterdir():
        path.chmod(0o644)
    with serving(folder) as running:
        yield running, folder


def test_the_registry_is_that_of_the_real_files(utias_folder: Path) -> None:
    registry = {file.name: (file.size_bytes, file.sha256) for file in utias_files()}
    real = {
        path.name: (path.stat().st_size, hashlib.sha256(path.read_bytes()).hexdigest())
        for path in utias_folder.iterdir()
    }
    assert registry == real
    assert len(registry) == 146


def test_the_address_is_the_public_repository() -> None:
    assert "utiasSTARS/certifiable-rwhe-calibration/main/data/real-world/combined/" in UTIAS_URL


def test_everything_is_downloaded_and_can_be_read(server: Server, utias_folder: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int, str]] = []
    fetched = fetch_utias(tmp_path / "new" / "utias", server.url, lambda *call: seen.append(call))
    assert len(fetched.downloaded) == 146
    assert fetched.already_there == ()
    for path in utias_folder.iterdir():
        assert (fetched.folder / path.name).read_bytes() == path.read_bytes()
    assert [done for done, _, _ in seen] == list(range(147))
    assert seen[-1][1] == 146
    assert rw.read_csv(fetched.folder).number_of_measurements == 3230


def test_a_second_call_downloads_nothing(server: Server, utias_folder: Path) -> None:
    fetched = fetch_utias(utias_folder, server.url)
    assert fetched.downloaded == ()
    assert len(fetched.already_there) == 146
    assert server.requested == []


def test_an_interrupted_download_goes_on_where_it_was(server: Server, tmp_path: Path) -> None:
    def interrupt(done: int, total: int, name: str) -> None:
        if done == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch_utias(tmp_path, server.url, interrupt)
    assert len(list(tmp_path.iterdir())) == 10
    server.requested.clear()
    fetched = fetch_utias(tmp_path, server.url)
    assert len(fetched.already_there) == 10
    assert len(server.requested) == len(fetched.downloaded) == 136
    assert len(list(tmp_path.iterdir())) == 146


def test_another_checksum_is_refused_and_nothing_is_written(spoilt: tuple[Server, Path], tmp_path: Path) -> None:
    server, folder = spoilt
    name = utias_files()[5].name
    content = bytearray((folder / name).read_bytes())
    content[100] ^= 1
    (folder / name).write_bytes(content)
    destination = tmp_path / "utias"
    with pytest.raises(FetchError, match=rf"{name}: .* with SHA-256 .* expected .*Nothing was written"):
        fetch_utias(destination, server.url)
    assert sorted(path.name for path in destination.iterdir()) == sorted(file.name for file in utias_files()[:5])


@pytest.mark.parametrize(("kept_bytes", "words"), [(-10, r"\d+ bytes"), (None, r"not found \(404\)")])
def test_a_truncated_and_a_missing_file_are_refused(
    spoilt: tuple[Server, Path], kept_bytes: int | None, words: str, tmp_path: Path
) -> None:
    server, folder = spoilt
    file = folder / utias_files()[3].name
    if kept_bytes is None:
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:kept_bytes])
    with pytest.raises(FetchError, match=rf"{file.name}: {words}"):
        fetch_utias(tmp_path / "utias", server.url)
    assert len(list((tmp_path / "utias").iterdir())) == 3


def test_a_passing_fault_is_tried_again(server: Server, tmp_path: Path) -> None:
    server.answers.extend([503, 500])
    assert len(fetch_utias(tmp_path, server.url).downloaded) == 146
    assert len(server.requested) == 148


def test_a_server_that_stays_out_of_order(server: Server, tmp_path: Path) -> None:
    server.answers.extend([503] * 10)
    with pytest.raises(FetchError, match="503"):
        fetch_utias(tmp_path, server.url)


def test_no_network_and_no_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound and not listening: a connection is refused
        with pytest.raises(FetchError, match="Is there a network"):
            fetch_utias(tmp_path, f"http://127.0.0.1:{unused.getsockname()[1]}/")
    with pytest.raises(FetchError, match="cannot be downloaded"):
        fetch_utias(tmp_path, "not-an-address")


def test_the_users_own_file_is_never_overwritten(server: Server, tmp_path: Path) -> None:
    own = tmp_path / utias_files()[7].name
    own.write_text("my own measurements", encoding="utf-8")
    with pytest.raises(FetchError, match="Nothing was overwritten"):
        fetch_utias(tmp_path, server.url)
    assert own.read_text(encoding="utf-8") == "my own measurements"
    assert server.requested == []


def test_a_destination_that_is_a_file(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FetchError, match="cannot be made a folder"):
        fetch_utias(tmp_path / "file", server.url)


@pytest.fixture(scope="module")
def make_demo() -> ModuleType:
    """The script ``data/make_demo.py``."""
    return script(DATA / "make_demo.py")


def test_the_script_makes_the_same_files_again(make_demo: ModuleType, tmp_path: Path) -> None:
    make_demo.write(tmp_path)
    names = sorted(path.name for path in (DATA / "demo").iterdir())
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for name in names:
        stored, made = (np.loadtxt(folder / name, delimiter=",", ndmin=2) for folder in (DATA / "demo", tmp_path))
        np.testing.assert_allclose(made, stored, rtol=0.0, atol=2e-9)


def test_the_calibration_is_certified_and_near_the_truth(make_demo: ModuleType) -> None:
    problem = rw.read_csv(DATA / "demo", sigma=make_demo.SIGMA_M, kappa=1.0 / (2.0 * make_demo.SIGMA_RAD**2))
    solution = rw.solve(problem)
    assert solution.certificate.is_certified
    for answer, truth in ((solution.X, make_demo.true_targets()), (solution.Y, make_demo.true_sensors())):
        assert set(answer) == set(truth)
        for name in truth:
            error = truth[name].between(answer[name])
            assert np.linalg.norm(error.translation()) < 0.01
            assert np.degrees(np.linalg.norm(error.rotation().xyz())) < 0.7
    # Half a chi-square with 6 x 133 - 6 x 7 degrees of freedom: mean 378, standard deviation 19.4.
    assert abs(solution.cost - 378.0) < 4 * 19.4
