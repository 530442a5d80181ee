"""`magtwin fetch` against a web server of our own on loopback."""

import hashlib
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from magtwin.errors import InputError
from magtwin.fetch import SOURCES, Source, fetch, is_complete


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture
def mirror(tmp_path):
    """A folder served on loopback: (folder, base URL)."""
    folder = tmp_path / "mirror"
    folder.mkdir()
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield folder, f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


@pytest.fixture
def table(monkeypatch):
    """Make `fetch` know one source, named tiny, with the given files."""

    def define(**contents):
        files = [(name, hashlib.sha256(data).hexdigest(), f"data/{name}") for name, data in contents.items()]
        monkeypatch.setattr(Source, "files", lambda self: files)
        monkeypatch.setitem(SOURCES, "tiny", (Source("tiny.txt", "http://127.0.0.1:9", "MIT"),))

    return define


def test_files_come_whole_from_the_base_url(mirror, table, tmp_path):
    folder, url = mirror
    (folder / "data").mkdir()
    (folder / "data" / "a").write_bytes(b"alpha")
    (folder / "data" / "b").write_bytes(b"beta")
    table(a=b"alpha", b=b"beta")
    seen = []
    files = fetch("tiny", tmp_path / "out", base_url=url, progress=lambda *step: seen.append(step))
    assert [f.read_bytes() for f in files] == [b"alpha", b"beta"]
    assert seen == [(0, 2, "a"), (1, 2, "b"), (2, 2, "")]
    assert is_complete("tiny", tmp_path / "out")
    files[0].write_bytes(b"alpho")
    assert not is_complete("tiny", tmp_path / "out")


@pytest.mark.parametrize(("served", "words"), [(b"something else", "SHA-256 is not"), (None, "404")])
def test_a_changed_or_missing_file_is_refused_and_nothing_is_left(mirror, table, tmp_path, served, words):
    folder, url = mirror
    (folder / "data").mkdir()
    (folder / "data" / "a").write_bytes(b"alpha")
    if served is not None:
        (folder / "data" / "b").write_bytes(served)
    table(a=b"alpha", b=b"beta")
    with pytest.raises(InputError, match=f"data/b: .*{words}"):
        fetch("tiny", tmp_path / "out", base_url=url)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mirror"]


@pytest.mark.parametrize(
    ("source", "out", "url", "words"),
    [
        ("aprilab", ".", "http://127.0.0.1:9", "exists already"),
        ("april", "out", "http://127.0.0.1:9", "did you mean 'aprilab'"),
        ("aprilab", "out", "file:///etc", "must begin with http"),
    ],
)
def test_what_is_not_fetched_is_refused(source, out, url, words, tmp_path):
    with pytest.raises(InputError, match=words):
        fetch(source, tmp_path / out, base_url=url)


def test_the_tables_agree_with_the_real_files(real_data):
    folders = {"map": "maps", "models": "models", "paths": "paths"}
    checked = 0
    for file, checksum, _ in SOURCES["aprilab"][0].files():
        top, _, name = file.partition("/")
        real = real_data / "aprilab" / folders.get(top, top) / name
        if real.is_file():
            assert hashlib.sha256(real.read_bytes()).hexdigest() == checksum
            checked += 1
    for source in SOURCES["turtlebot4"]:
        for file, checksum, _ in source.files():
            real = real_data / "turtlebot4" / "xacro" / file
            if real.is_file():
                assert hashlib.sha256(real.read_bytes()).hexdigest() == checksum
                checked += 1
    for name in ("magnetic-data", "magslam"):
        for source in SOURCES[name]:
            for file, checksum, _ in source.files():
                assert hashlib.sha256((real_data / name / file).read_bytes()).hexdigest() == checksum
                checked += 1
    for _, checksum, path in SOURCES["isaac-rules"][0].files():
        real = real_data / "isaacsim-6.0.1" / path.removeprefix("source/extensions/")
        assert hashlib.sha256(real.read_bytes()).hexdigest() == checksum
        checked += 1
    assert checked > 70
