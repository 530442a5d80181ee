import pytest

from magtwin.errors import InputError
from magtwin.learn.data.features import SETS
from magtwin.learn.training.config import TrainConfig, models, read_config


def test_what_is_not_said_is_as_the_paper_has_it():
    config = TrainConfig()
    assert (config.layers, config.dropout, config.inputs) == ((512,) * 4, 0.3, SETS["full"])
    assert TrainConfig(model="released").layers == (512, 512, 512, 128)


def test_a_configuration_comes_back_from_its_own_toml(tmp_path):
    config = TrainConfig(
        layers=(64, 32), features="yaw_sin, lidar_on", epochs=3, lr=2e-4, patience=5, split="path",
        hold_out=('a "b"', "ü"), threads=2, init=tmp_path / "a.safetensors", freeze=("layers.0",),
    )  # fmt: skip
    for one in (config, TrainConfig(), TrainConfig(model="released", features="lidar_on")):
        (tmp_path / "c.toml").write_text(one.to_toml(), encoding="utf-8")
        assert read_config(tmp_path / "c.toml") == one
    assert config.inputs == ("yaw_sin", "lidar_on")


@pytest.mark.parametrize("model", models())
def test_every_model_is_complete_without_a_word_and_comes_back_from_its_toml(tmp_path, model):
    config = TrainConfig(model=model)
    (tmp_path / "c.toml").write_text(config.to_toml(), encoding="utf-8")
    assert read_config(tmp_path / "c.toml") == config
    assert config.inputs


def test_another_model_leaves_the_options_of_the_one_before_behind():
    config = TrainConfig(model="hybrid", penalty=0.1, epochs=7, seed=4, features="circular")
    other = config.with_options(model="paper")
    assert (other.epochs, other.seed, other.features, other.penalty) == (7, 4, "circular", None)
    assert other.layers == TrainConfig().layers
    assert config.with_options(epochs=9) == TrainConfig(
        model="hybrid", penalty=0.1, epochs=9, seed=4, features="circular"
    )


def test_weights_to_go_on_from_lie_beside_the_file_that_names_them(tmp_path):
    (tmp_path / "c.toml").write_text('init = "a.safetensors"\n')
    assert read_config(tmp_path / "c.toml").init == tmp_path / "a.safetensors"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("epoch = 3", "c.toml:1: unknown key 'epoch'; did you mean 'epochs'?"),
        ("seed = 1\nepochs = 2.5", "c.toml:2: epochs must be a whole number, got 2.5"),
        ("epochs = 0", "c.toml:1: epochs must be above 0, got 0"),
        ("patience = 0", "c.toml:1: patience must be 1 at least, got 0; leave it out for none"),
        ("dropout = 1", "c.toml:1: dropout must be at least 0 and below 1, got 1.0"),
        ("seed = -1", "c.toml:1: seed must be 0 or more, got -1"),
        ("layers = [8, 0]", "c.toml:1: layers must be above 0 wide, got (8, 0)"),
        ("layers = [99999, 99999]", "make 10,001,899,980 weights; take 100,000,000 at most"),
        ('split = "day"', "c.toml:1: split must be one of 'session', 'run', 'path', 'row', got 'day'"),
        ('features = "ful"', "no feature set 'ful'; did you mean 'full'?"),
        ('features = "yaw_sin, lidar"', "no feature 'lidar'; did you mean 'lidar_on'?"),
        ('model = "linear"\nepochs = 3', "c.toml:2: epochs is no option of 'linear'; leave it out, or "
         "choose paper, released, hybrid"),
        ('model = "rigde"', "c.toml:1: no model 'rigde'; known: hybrid, linear, mixed, paper, released"),
        ('model = "hybrid"\npenalty = -1', "c.toml:2: penalty must be 0 or more and finite, got -1.0"),
        ('device = "gpu"', "c.toml:1: device must be one of 'cpu', 'cuda', 'auto', got 'gpu'"),
        ('freeze = ["layers.0"]', "freeze keeps layers of trained weights: give init too"),
    ],
)  # fmt: skip
def test_a_file_that_says_what_cannot_be_is_refused(tmp_path, text, said):
    (tmp_path / "c.toml").write_text(text + "\n")
    with pytest.raises(InputError) as refused:
        read_config(tmp_path / "c.toml")
    assert str(refused.value).endswith(said)


def test_a_licence_is_kept_in_a_configuration_and_none_is_left_out():
    assert 'licence = "MIT"' in TrainConfig(licence="MIT").to_toml()
    assert "licence" not in TrainConfig().to_toml()
    assert TrainConfig(licence="MIT").with_options(model="linear").licence == "MIT"
