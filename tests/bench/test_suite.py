"""Suites: keys, selections, seeds and refusals."""

import pytest

from magtwin.bench.suite import SUITES, load_suite
from magtwin.errors import InputError
from magtwin.localization.localizers import LOCALIZERS

TEXT = """
name = "small"
seed = 5
chunk = 4

[[scenario]]
name = "near"
runs = 10
sessions = 3

[[scenario]]
name = "far"
runs = 3
prior = "global"

[[localizer]]
method = "odometry"

[[localizer]]
name = "few"
method = "rbpf"
options = { particles = 200 }
scenarios = ["near"]
"""


@pytest.fixture
def write(tmp_path):
    def write(text=TEXT):
        file = tmp_path / "small.toml"
        file.write_text(text, encoding="utf-8")
        return file

    return write


@pytest.mark.parametrize("file", sorted(SUITES.glob("*.toml")), ids=lambda file: file.stem)
def test_a_suite_that_ships_loads_and_names_known_methods(file):
    suite = load_suite(file.stem)
    assert suite.name == file.stem.removesuffix("-1")
    assert {entry.method for entry in suite.localizer} <= set(LOCALIZERS)
    assert suite.chunks()


def test_the_standard_suite_needs_nothing_but_magtwin():
    load_suite("standard").check()


def test_chunks_cover_every_run_of_every_localizer_once(write):
    suite = load_suite(write())
    runs = [
        (chunk.scenario, name, run)
        for chunk in suite.chunks()
        for name in chunk.entries
        for run in range(chunk.first, chunk.first + chunk.runs)
    ]
    assert len(runs) == len(set(runs)) == 10 + 10 + 3
    assert ("far", "few", 0) not in runs


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("sessions = 3", "sesions = 3", "unknown key 'sesions'; did you mean 'sessions'"),
        ('prior = "global"', 'prior = "globe"', r"small.toml:14: \[scenario\] prior must be one of"),
        ("runs = 3", "runs = 0", "runs must be at least 1, got 0"),
        ('name = "far"', 'name = "near"', r"two of \[\[scenario\]\] are called 'near'"),
        ('name = "far"', 'name = "../x"', "lower-case letters, digits and hyphens"),
        ('scenarios = ["near"]', 'scenarios = ["near", "fra"]', "no scenario 'fra'; did you mean 'far'"),
        ("chunk = 4", "chunk = 0", "chunk and time_limit_s must be above 0"),
        ("runs = 3", "runs = 3\nsensor = { white_nt = -1.0 }", "white_nt of SensorModel must be finite"),
        ("runs = 3", "runs = 3\n[scenario.odometry_model]\nyaw_sd = 1.0", "unknown key 'yaw_sd'"),
        ("runs = 3", "runs = 3\nkidnap_m = [4.0, 0.5]", "kidnap_m must be two ascending distances"),
        ("runs = 3", "runs = 3\nduration_s = 1e9", "over a million readings"),
        ("runs = 3", "runs = 3\nmap_length_m = 1e-300", "map_length_m must be at least 0.001, got 1e-300"),
        ("runs = 3", "runs = 3\nkidnaps = 1_000_000_000_000", "kidnaps must be 0 to "),
        ("runs = 3", "runs = 1_000_000", "1,000,010 runs together; at most 1,000,000"),
        ("[[scenario]]", '[[localizer]]\nmethod = "ekf"\n' * 1000 + "[[scenario]]", "over 1,000 of"),
        ("seed = 5", f"seed = {2**63 - 10**9 - 12}", "small.toml:3: seed must be at most 9,223,372,035,85"),
    ],
)
def test_a_wrong_suite_is_refused(write, old, new, text):
    with pytest.raises(InputError, match=text):
        load_suite(write(TEXT.replace(old, new)))


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('method = "rbpf"', 'method = "rbfp"', "no localizer 'rbfp'; did you mean 'rbpf'"),
        ("runs = 3", 'runs = 3\npaths = ["sine", "figur8"]', r"'figur8' \(did you mean 'figure8'"),
        ("particles = 200", "partikles = 200", "'rbpf' has no option 'partikles'; did you mean 'particles'"),
        ('method = "rbpf"', 'method = "no_such_module:Filter"', "cannot be imported: ModuleNotFoundError"),
        ('method = "rbpf"', 'method = "math:tau"', "cannot be made|must have the methods"),
        ("runs = 3", 'runs = 3\nscene = "lub"', "no scene 'lub'; did you mean 'lab'"),
        ("runs = 3", 'runs = 3\ndata = "elsewhere"', "scenario 'far' needs the data 'elsewhere'"),
        ("runs = 3", 'runs = 3\nsource = "ship"', "name them by its key data"),
        ('method = "odometry"', 'method = "odometry"\ncompensator = "irn"', "no compensator 'irn'"),
    ],
)
def test_what_a_suite_names_is_looked_for_before_anything_runs(write, old, new, text):
    file = write(TEXT.replace(old, new))
    with pytest.raises(InputError, match=text):
        load_suite(file).check(file)


def test_a_suite_without_localizers_needs_them_given(write, tmp_path):
    file = write(TEXT.partition("[[localizer]]")[0])
    with pytest.raises(InputError, match=r"the suite has no .*give `localizers`"):
        load_suite(file).check(file)
    given = load_suite(file).limited(localizers=["odometry"])
    given.check(file)
    assert [chunk.entries for chunk in given.chunks()] == [("odometry",)] * 4
    with pytest.raises(InputError, match=r"^no localizer 'odometer'; did you mean 'odometry'"):
        load_suite(file).limited(localizers=["odometer"]).check(file)


def test_a_path_of_a_file_is_relative_to_the_suite(write, tmp_path):
    suite = load_suite(write(TEXT.replace("runs = 3", 'runs = 3\npaths = ["loop.csv"]')))
    with pytest.raises(InputError, match=r"loop.csv"):
        suite.check()
    (tmp_path / "loop.csv").write_text("x,y\n0,0\n1,0\n1,1\n")
    suite.check()
    assert suite.path("loop.csv") == str(tmp_path / "loop.csv")
    assert suite.path("sine") == "sine"


def test_data_are_relative_to_the_suite_and_can_be_given(write, tmp_path):
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    text = TEXT.replace("chunk = 4", 'chunk = 4\ndata = { loops = "here" }').replace(
        "runs = 3", 'runs = 3\nsource = "ship"\ndata = "loops"'
    )
    suite = load_suite(write(text))
    assert suite.folder(suite.scenarios["far"]) == tmp_path / "here"
    given = suite.limited(data={"loops": str(tmp_path / "there")})
    assert given.folder(given.scenarios["far"]) == tmp_path / "there"
    with pytest.raises(InputError, match="no such folder of data 'loops'"):
        suite.limited(data={"loops": "nowhere"}).check()
