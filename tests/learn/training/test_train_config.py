import pytest

from magtwin.errors import InputError
from magtwin.learn.training.config import TrainConfig, models, read_config


def test_a_configuration_comes_back_from_its_own_toml(tmp_path):
    config = TrainConfig(
        layers=(64, 32), features="yaw_sin, lidar_on", epochs=3, lr=2e-4, patience=5, split="path",
        hold_out=('a "b"', "ü"), threads=2, init=tmp_path / "a.safetensors",
    )  # fmt: skip
    for one in (config, TrainConfig(), TrainConfig(model="hybrid", features="lidar_on")):
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
        ("epoch = 3", ":1: unknown key 'epoch'; did you mean 'epochs'"),
        ("seed = 1\nepochs = 2.5", ":2: epochs must be a whole number"),
        ("epochs = 0", ":1: epochs must be between 1"),
        ("dropout = 1", ":1: dropout must be between 0"),
        ("seed = -1", ":1: seed must be between 0"),
        ("layers = [8, 0]", ":1: layers must be above 0 wide"),
        ("layers = [99999, 99999]", "make 10,001,899,980 weights"),
        ('split = "day"', ":1: split must be one of"),
        ('features = "ful"', "no feature set 'ful'; did you mean 'full'"),
        ('model = "linear"\nepochs = 3', ":2: epochs is no option of 'linear'; leave it out"),
        ('model = "rigde"', ":1: no model 'rigde'; known: hybrid, linear"),
        ('model = "hybrid"\npenalty = -1', ":2: penalty must be between 0"),
        ('device = "gpu"', ":1: device must be one of"),
    ],
)
def test_a_file_that_says_what_cannot_be_is_refused(tmp_path, text, said):
    (tmp_path / "c.toml").write_text(text + "\n")
    with pytest.raises(InputError) as refused:
        read_config(tmp_path / "c.toml")
    assert said in str(refused.value)
