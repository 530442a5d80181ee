"""A scene's stage is opened once; its parts are read from that one stage."""

from pathlib import Path

import pytest
from pxr import Usd

from magtwin.errors import InputError, UnknownNameError
from magtwin.files.file import shipped
from magtwin.usd.lab.obstacles import read_obstacles
from magtwin.usd.layers import open_stage, stage_sha256
from magtwin.usd.maps.layer import load_map
from magtwin.usd.scene import open_scene, read_scene

LAB = shipped("scenes", "lab", "lab.usda")


def test_parts_of_an_opened_scene_are_those_read_one_by_one(monkeypatch):
    scene, field, obstacles = read_scene(LAB), load_map(read_scene(LAB).map_layer), read_obstacles(LAB)
    opened = open_scene(LAB)
    monkeypatch.setattr(Usd.Stage, "Open", None)  # parts need no other stage
    assert opened.file == Path(LAB)
    assert opened.scene == scene
    assert (opened.map.values_nt == field.values_nt).all()
    assert opened.obstacles.names == obstacles.names
    assert opened.obstacles is opened.obstacles
    assert {shape.link for shape in opened.shapes} <= {"", *opened.links}
    assert opened.alone(scene.robot.name) is opened, "it is alone already"
    with pytest.raises(UnknownNameError, match="no robot 'nobody'"):
        opened.alone("nobody")
    monkeypatch.undo()
    assert opened.sha256 == stage_sha256(LAB)


def test_a_stage_opened_by_a_link_that_hides_its_layers_is_refused_with_the_stage(tmp_path):
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "cup.usda").write_text('#usda 1.0\ndef "Cup" {}\n')
    stage = tmp_path / "lab" / "lab.usda"
    stage.write_text('#usda 1.0\ndef "World" (references = @./cup.usda@</Cup>) {}\n')
    (link := tmp_path / "link.usda").symlink_to("lab/lab.usda")
    open_stage(stage)
    with pytest.raises(InputError, match=rf"it is a link, beside which USD looks: give {stage}$"):
        open_stage(link)


def test_a_stage_of_another_program_is_refused_with_how_a_room_is_made(tmp_path):
    (tmp_path / "room.usda").write_text(
        '#usda 1.0\n(\n    metersPerUnit = 1\n    upAxis = "Z"\n)\ndef Cube "Box" {}\n'
    )
    with pytest.raises(InputError, match="found none; it is a stage without a scene"):
        open_scene(tmp_path / "room.usda")
