"""Outputs are whole or absent; settings are checked key by key."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from magtwin.errors import InputError
from magtwin.files.file import existing
from magtwin.files.kinds import SCENE_TOML, kind_of, stage_in
from magtwin.files.outputs import check_free, output
from magtwin.files.settings import from_table, read_toml


@dataclass(frozen=True, kw_only=True)
class Wheel:
    radius_m: float
    """Radius [m]."""

    def __post_init__(self):
        if self.radius_m <= 0:
            raise InputError(f"radius_m must be above 0, got {self.radius_m}")


@dataclass(frozen=True, kw_only=True)
class Cart:
    name: str
    wheels: tuple[Wheel, ...] = ()
    spare: Wheel = field(default_factory=lambda: Wheel(radius_m=1.0))
    place: tuple[float, float] = (0.0, 0.0)
    asset: Path | None = None
    laps: int = 1
    cargo: Mapping[str, Path] = field(default_factory=dict)
    gear: Literal["low", "high"] = "low"


def read_cart(tmp_path, text):
    file = tmp_path / "cart.toml"
    file.write_text(text)
    return from_table(Cart, read_toml(file), file)


def test_a_table_becomes_the_dataclass_with_nested_tables_and_paths_from_its_folder(tmp_path):
    cart = read_cart(
        tmp_path,
        'name = "a"\nplace = [1, 2.5]\nasset = "x/y.usda"\n'
        '[spare]\nradius_m = 2\n[cargo]\nbox = "b"\n[[wheels]]\nradius_m = 3.0\n',
    )
    assert cart == Cart(
        name="a",
        wheels=(Wheel(radius_m=3.0),),
        spare=Wheel(radius_m=2.0),
        place=(1.0, 2.5),
        asset=tmp_path / "x" / "y.usda",
        cargo={"box": tmp_path / "b"},
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "a"\nplase = [1, 2]', r"cart.toml:2: unknown key 'plase'; did you mean 'place'"),
        ('name = "a"\n[spare]\nradius = 2', r"cart.toml:3: \[spare\] unknown key 'radius'; .* 'radius_m'"),
        ('name = "a"\ngear = "hgh"', r"cart.toml:2: gear must be one of 'low', 'high', got 'hgh'"),
        ("laps = 2", r"cart.toml: key 'name' is missing"),
        ('name = "a"\ncargo = 3', r"cart.toml:2: cargo must be a table, got 3"),
        ('name = "a"\nlaps = 2.5', r"cart.toml:2: laps must be a whole number, got 2.5"),
        ('name = "a"\nlaps = true', r"cart.toml:2: laps must be a whole number, got True"),
        ('name = "a"\nplace = [1]', r"cart.toml:2: place must be a list of 2, each a number, got \[1\]"),
        ('name = "a"\nspare = 3', r"cart.toml:2: spare must be a table, got 3"),
        ('name = "a"\n[spare]\nradius_m = -1', r"cart.toml:3: \[spare\] radius_m must be above 0, got -1"),
        ('name = "a"\nlaps = = 2', r"cart.toml: not TOML: .*line 2"),
    ],
)
def test_a_wrong_table_is_refused_with_file_line_and_what_was_seen(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_cart(tmp_path, text)


def test_a_toml_with_a_byte_order_mark_is_read_and_its_lines_are_named(tmp_path):
    file = tmp_path / "cart.toml"
    file.write_text('lap = 2\nname = "a"\n', encoding="utf-8-sig")
    assert read_toml(file) == {"lap": 2, "name": "a"}
    with pytest.raises(InputError, match=r"cart\.toml:1: unknown key 'lap'"):
        from_table(Cart, read_toml(file), file)
    file.write_text('[lab]\nname = "a"\n', encoding="utf-8-sig")
    assert kind_of(file) is SCENE_TOML


def test_a_missing_file_is_refused_with_a_near_name_or_what_its_link_names(tmp_path):
    (tmp_path / "run.parquet").symlink_to("gone.parquet")
    for name, words in {
        "run.parquet": r"a link to 'gone\.parquet', which does not exist",
        "rum.parquet": r"no such run; did you mean 'run\.parquet'\?",
        "mine.parquet": "no such run; magtwin run lab makes",
    }.items():
        with pytest.raises(InputError, match=words):
            existing(tmp_path / name, "run")


def test_an_output_below_a_file_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"cannot be written, as .*file is no folder"):
        check_free(tmp_path / "file" / "a.txt")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("", "is the working folder or contains it"),
        ("..", "is the working folder or contains it"),
        ("/", "is the working folder or contains it"),
        ("home", "is the home folder or contains it"),
        ("/dev/null", "a device or pipe"),
        (" ", "' ': a blank name"),
        (".csv", r"a suffix without a name; give one, such as run\.csv"),
        ("a/.parquet", "a suffix without a name"),
        ("bad\udcff.parquet", "its name is not UTF-8"),
    ],
)
@pytest.mark.parametrize("force", [False, True])
def test_what_no_output_can_be_called_is_refused_at_once(tmp_path, monkeypatch, name, text, force):
    (tmp_path / "home").mkdir()
    (tmp_path / "work").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "work")
    with pytest.raises(InputError, match=text):
        check_free(tmp_path / name if name == "home" else name, force=force)


def test_a_folder_with_files_of_the_user_is_not_replaced(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").touch()
    with pytest.raises(InputError, match=r"holds notes\.txt"), output(tmp_path / "run", force=True) as aside:
        aside.mkdir()
    assert (tmp_path / "run" / "notes.txt").exists()


@pytest.mark.parametrize(
    "text", ['"""' * 30_001, "x = '''a" + "\\n''''" * 30_000, 'x = "' + '\\\\"' * 60_000]
)
def test_texts_of_toml_without_an_end_are_refused(text, tmp_path):
    with pytest.raises(InputError, match="not TOML"):
        read_cart(tmp_path, text)


@pytest.mark.parametrize("quote", ['"', "'"])
def test_levels_after_a_text_that_ends_in_a_quote_are_counted(quote, tmp_path):
    text = f"x = [{3 * quote}a{4 * quote}, {'[' * 40}{']' * 40}, {2 * quote}]"
    with pytest.raises(InputError, match="nests deeper than 16 levels"):
        read_cart(tmp_path, text)


def test_the_stage_of_a_folder_is_the_scene_and_not_a_part_of_it_with_the_folders_name(tmp_path):
    folder = tmp_path / "room"
    folder.mkdir()
    (folder / "room.usda").write_text("#usda 1.0\n")
    assert stage_in(folder) == folder / "room.usda"
    (folder / "l_room.usda").write_text("#usda 1.0\n(\n    subLayers = [@./magnetics.usda@]\n)\n")
    assert stage_in(folder) == folder / "l_room.usda"
    (folder / "room_layer.usda").write_text("#usda 1.0\n")
    assert stage_in(folder) == folder / "room.usda"
