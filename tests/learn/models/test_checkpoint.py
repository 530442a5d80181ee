"""The released checkpoint, and what must never come through the reader."""

import builtins
import io
import os
import pickle
import struct
import subprocess
import sys
import zipfile
from collections import OrderedDict
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.learn.models.checkpoint import read_checkpoint

RELEASED = "aprilab/models/nn_magnetometer_model_v0.0.1.pth"

# What the tests below pickle stands in for these; a pickle only knows them by name.
STAND_INS = {}


def stand_in(module, name):
    """A class that pickles under the name of another, without that other being there."""
    cls = type(name, (), {"__module__": module, "__qualname__": name})
    STAND_INS[cls] = (module, name)
    return cls


StandardScaler = stand_in("sklearn.preprocessing._data", "StandardScaler")
FloatStorage = stand_in("torch", "FloatStorage")
Rebuild = stand_in("torch._utils", "_rebuild_tensor_v2")


class Tensor:
    """An array that pickles as torch pickles a tensor."""

    def __init__(self, array):
        self.array = np.asarray(array, "<f4")


class Stored:
    """A storage, which a pickle keeps outside itself."""

    def __init__(self, key, numbers):
        self.key, self.numbers = key, numbers


class Saver(pickle._Pickler):
    """Pickles as torch.save does: tensors outside, globals by name, nothing imported."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)

    def __init__(self, file, protocol):
        super().__init__(file, protocol)
        self.storages = []

    def persistent_id(self, obj):
        if isinstance(obj, Stored):
            return ("storage", FloatStorage, obj.key, "cpu", obj.numbers)
        return None

    def save_global(self, obj, name=None):
        if obj in STAND_INS:
            module, name = STAND_INS[obj]
            if self.proto >= 4:
                self.save(module)
                self.save(name)
                self.write(pickle.STACK_GLOBAL)
            else:
                self.write(pickle.GLOBAL + f"{module}\n{name}\n".encode())
            return None
        return super().save_global(obj, name)

    dispatch[type] = save_global

    def reducer_override(self, obj):
        if isinstance(obj, Tensor):
            self.storages.append(obj.array.tobytes())
            stored = Stored(str(len(self.storages) - 1), obj.array.size)
            stride = tuple(s // 4 for s in obj.array.strides)
            return Rebuild, (stored, 0, obj.array.shape, stride, False, OrderedDict())
        return NotImplemented


def scaler(mean, scale):
    made = StandardScaler()
    made.mean_, made.scale_, made.n_samples_seen_ = np.array(mean, float), np.array(scale, float), 7
    made._sklearn_version = "1.5.2"
    return made


def layers(*widths, seed=0):
    rng = np.random.default_rng(seed)
    state = OrderedDict()
    for i, (a, b) in enumerate(pairwise(widths)):
        state[f"layer{i}.weight"] = Tensor(rng.normal(size=(b, a)))
        state[f"layer{i}.bias"] = Tensor(rng.normal(size=b))
    return state


def saved(state=None, **changes):
    state = layers(20, 4, 1) if state is None else state
    held = {
        "model_state_dict": state,
        "scaler_X": scaler(np.arange(20), np.ones(20)),
        "scaler_y": scaler([300.0], [500.0]),
    } | changes
    return {key: value for key, value in held.items() if value is not None}


def pth(path, held, *, protocol=2, pickled=None, members=None, compression=zipfile.ZIP_STORED):
    """A checkpoint file of `held`, as torch.save lays it out."""
    buffer = io.BytesIO()
    saver = Saver(buffer, protocol)
    saver.dump(held)
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("net/data.pkl", buffer.getvalue() if pickled is None else pickled)
        archive.writestr("net/byteorder", "little")
        for i, data in enumerate(saver.storages):
            archive.writestr(f"net/data/{i}", data)
        for name, data in (members or {}).items():
            archive.writestr(name, data)
    return path


def replace(path, members):
    """Put other bytes in place of members of a zip."""
    with zipfile.ZipFile(path) as archive:
        kept = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in (kept | members).items():
            archive.writestr(name, data)


def refusal(path, inputs=20):
    with pytest.raises(InputError) as refused:
        read_checkpoint(path, inputs)
    text = str(refused.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text.removeprefix(f"{path}: ")


# The real file


def test_the_released_network_has_601857_parameters_in_5_layers(real_data):
    net = read_checkpoint(real_data / RELEASED, 20)
    assert [w.shape for w, _ in net.layers] == [(512, 20), (512, 512), (512, 512), (128, 512), (1, 128)]
    assert sum(w.size + b.size for w, b in net.layers) == 601_857


def test_the_released_scalers_are_the_published_figures(real_data):
    net = read_checkpoint(real_data / RELEASED)
    # Mean and scale of each input, to the digits that were noted when the file was first looked at.
    figures = """
        180.295 101.551   .232589 .0658757  3.06e-4 2.75e-3  -2.6e-6 1.35e-4  4.3e-5 .010961
        2.75e-4 .028157   .009994 .524086  -.001381 .004811  -.001085 .006556  .002862 .696160
        .664672 .271099  -2.2e-6 .012694  2.30e-4 .039108  .007966 .512536  -.004313 .424792
        .002215 .271545  .021819 .980056  15.6979 .532527  .856926 .140275  .340609 .473914
    """
    mean, scale = np.array(figures.split(), float).reshape(20, 2).T
    assert_allclose(net.x_mean, mean, rtol=2e-2)
    assert_allclose(net.x_mean[[0, 1, 17, 18, 19]], mean[[0, 1, 17, 18, 19]], rtol=1e-5)
    assert_allclose(net.x_scale, scale, rtol=3e-3)
    assert_allclose([net.y_mean, net.y_scale], [366.662, 524.898], rtol=1e-6)
    assert net.samples == 591_952
    assert net.written_by == "scikit-learn 1.5.2"


def test_reading_imports_neither_torch_nor_scikit_learn(real_data):
    code = (
        "import sys; from magtwin.learn.models.checkpoint import read_checkpoint; "
        f"read_checkpoint({str(real_data / RELEASED)!r}); "
        "print([m for m in ('torch', 'sklearn') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# Round trips through files of our own making


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_a_checkpoint_of_each_protocol_gives_back_what_was_saved(tmp_path, protocol):
    state = layers(20, 8, 4, 1)
    net = read_checkpoint(pth(tmp_path / "a.pth", saved(state), protocol=protocol), 20)
    assert len(net.layers) == 3
    for i, (weight, bias) in enumerate(net.layers):
        assert_array_equal(weight, state[f"layer{i}.weight"].array)
        assert_array_equal(bias, state[f"layer{i}.bias"].array)
    assert_array_equal(net.x_mean, np.arange(20))
    assert (net.y_mean, net.y_scale, net.samples) == (300.0, 500.0, 7)


def test_a_transposed_tensor_is_read_by_its_strides(tmp_path):
    state = layers(20, 4, 1)
    transposed = np.asfortranarray(state["layer0.weight"].array)
    state["layer0.weight"] = Tensor(transposed)
    path = pth(tmp_path / "a.pth", saved(state))
    replace(path, {"net/data/0": transposed.tobytes(order="F")})  # columns, where the strides expect them
    assert_array_equal(read_checkpoint(path).layers[0][0], transposed)


# Pickles that would run something. Each leaves a mark if it does.


class Calls:
    """Pickles as a call of `function`."""

    def __init__(self, function, *args):
        self.function, self.args = function, args

    def __reduce__(self):
        return self.function, self.args


def marked(tmp_path):
    return tmp_path / "executed"


def hostile_pickles(mark):
    """Pickles that make a file `mark` when loaded, and the foreign global that each names."""
    touch = f"touch {mark}"
    code = f"open({str(mark)!r}, 'w').close()"
    stack_global = pickle.dumps(Calls(builtins.eval, code), 4)
    assert b"\x93" in stack_global  # STACK_GLOBAL
    nested = {"model_state_dict": OrderedDict(a=[({"b": Calls(os.system, touch)},)])}
    line = touch.encode()
    return {
        "os.system by REDUCE": (pickle.dumps(Calls(os.system, touch), 2), "posix.system"),
        "builtins.eval by STACK_GLOBAL": (stack_global, "builtins.eval"),
        "builtins.exec by GLOBAL": (pickle.dumps(Calls(exec, code), 2), "__builtin__.exec"),
        "deep inside": (pickle.dumps(nested, 4), "posix.system"),
        "by INST": (b"\x80\x02(U\x04trueios\nsystem\n.".replace(b"U\x04true", b""), "os.system"),
        "by the old text protocol": (b"cos\nsystem\n(S'" + line + b"'\ntR.", "os.system"),
        "by BUILD on a class": (
            b"\x80\x02csklearn.preprocessing._data\nStandardScaler\n}X\x0c\x00\x00\x00__setstate__"
            b"cos\nsystem\nsbX" + struct.pack("<I", len(line)) + line + b"b.",
            "os.system",
        ),
        "by getattr": (
            pickle.dumps(Calls(getattr, {}, "clear"), 2).replace(b"__builtin__", b"builtins"),
            "builtins.getattr",
        ),
        "by a method of an admitted class": (
            b"\x80\x04\x8c\x05numpy\x8c\x10ndarray.__init__\x93)R.",
            "numpy.ndarray.__init__",
        ),
        "by an import that has effects": (b"\x80\x02cantigravity\ngeohash\n.", "antigravity.geohash"),
        "torch's own unsafe loader": (b"\x80\x02ctorch\nload\n.", "torch.load"),
    }


@pytest.mark.parametrize("kind", list(hostile_pickles("x")))
def test_a_pickle_that_calls_is_refused_by_the_name_of_what_it_calls(tmp_path, kind):
    pickled, name = hostile_pickles(marked(tmp_path))[kind]
    before = set(sys.modules)
    text = refusal(pth(tmp_path / "evil.pth", saved(), pickled=pickled))
    assert text == (
        f"its pickle asks for {name}, which no network needs; nothing of it was executed, "
        "do not load this file with other programs"
    )
    assert not marked(tmp_path).exists()
    assert "antigravity" not in set(sys.modules) - before


def test_the_hostile_pickles_do_execute_under_pickle(tmp_path):
    pickled, _ = hostile_pickles(marked(tmp_path))["builtins.eval by STACK_GLOBAL"]
    pickle.loads(pickled)
    assert marked(tmp_path).exists()


def test_a_state_cannot_change_what_an_admitted_name_stands_for(tmp_path):
    # BUILD on the bare name would set attributes of a class that later files share
    pickled = b"\x80\x02csklearn.preprocessing._data\nStandardScaler\n}X\x01\x00\x00\x00aK\x01sb."
    text = refusal(pth(tmp_path / "a.pth", saved(), pickled=pickled))
    assert text == "damaged pickle at byte 56 (a state for a Global); get the file again"


@pytest.mark.parametrize(
    ("pickled", "text"),
    [
        (b"", "damaged pickle at byte 0 (pickle exhausted before seeing STOP); get the file again"),
        (b"\x80\x02}", "damaged pickle at byte 2 (pickle exhausted before seeing STOP); get the file again"),
        (
            b"\x80\x02K\x01.",
            "its pickle holds no dict; a checkpoint has model_state_dict, scaler_X and scaler_y",
        ),
        (b"\x80\x02}}.", "damaged pickle at byte 4 (values left over at its end); get the file again"),
        (b"\x80\x02h\x05.", "damaged pickle at byte 2 (nothing was kept as 5); get the file again"),
        (b"\x80\x02R.", "damaged pickle at byte 2 (too few values on its stack); get the file again"),
        (b"\x80\x02u.", "damaged pickle at byte 2 (no mark on its stack); get the file again"),
        (b"\x80\x02})R.", "damaged pickle at byte 4 (a call of a dict); get the file again"),
        (b"\x80\x02}))K\x01u.", "damaged pickle at byte 7 (no mark on its stack); get the file again"),
        (b"\x80\x02(R.", "damaged pickle at byte 3 (too few values on its stack); get the file again"),
        (b"\x80\x02\x82\x01.", "its pickle uses EXT1, which no network needs; nothing of it was executed"),
    ],
)
def test_a_damaged_pickle_is_refused_with_the_byte(tmp_path, pickled, text):
    assert refusal(pth(tmp_path / "a.pth", saved(), pickled=pickled)) == text


def test_keys_that_take_for_ever_to_hash_are_refused_at_once(tmp_path):
    doubled = b"\x80\x02}(K\x01" + b"".join(b"q\x00h\x00\x86" for _ in range(60)) + b"K\x01u."
    text = refusal(pth(tmp_path / "a.pth", saved(), pickled=doubled))
    assert text.endswith("(a key that is a tuple); get the file again")


# Files that are not such a zip


def test_a_file_that_is_no_zip_is_refused(tmp_path):
    path = tmp_path / "a.pth"
    path.write_bytes(b"GIF89a..")
    assert refusal(path) == "not a checkpoint: torch.save writes a zip, this begins with b'GIF8'"


def test_a_bare_pickle_is_refused(tmp_path):
    path = tmp_path / "a.pth"
    path.write_bytes(pickle.dumps(Calls(os.system, "true"), 2))
    assert refusal(path) == "a bare pickle, not the zip that torch.save writes since 1.6; save it anew"


def test_a_missing_file_is_refused_with_the_near_one(tmp_path):
    (tmp_path / "net.pth").write_bytes(b"")
    assert refusal(tmp_path / "nett.pth") == "no such checkpoint; did you mean 'net.pth'?"


def test_a_truncated_zip_is_refused(tmp_path):
    path = pth(tmp_path / "a.pth", saved())
    path.write_bytes(path.read_bytes()[:-100])
    text = refusal(path)
    assert text == "a zip that is cut short or damaged (File is not a zip file); get the file again"


def test_a_flipped_bit_in_a_tensor_is_refused_by_its_checksum(tmp_path):
    path = pth(tmp_path / "a.pth", saved())
    data = bytearray(path.read_bytes())
    data[data.index(b"net/data/0") + 30] ^= 1
    path.write_bytes(data)
    assert refusal(path).startswith("member data/0 is damaged (Bad CRC-32 for file 'net/data/0')")


def test_packed_members_are_refused_so_that_none_can_swell(tmp_path):
    bomb = {"net/data/9": bytes(10_000_000)}
    path = pth(tmp_path / "a.pth", saved(), members=bomb, compression=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 100_000
    assert refusal(path) == "member 'net/data.pkl' is packed or locked; torch.save stores them"


def test_a_member_that_claims_more_bytes_than_the_file_has_is_refused(tmp_path):
    path = pth(tmp_path / "a.pth", saved())
    data = bytearray(path.read_bytes())
    at = data.rindex(b"PK\x01\x02")  # the last member's entry in the central directory
    data[at + 20 : at + 28] = struct.pack("<II", 2**31, 2**31)
    path.write_bytes(data)
    assert refusal(path) == f"its members claim more bytes than the {len(data)} of the file"


@pytest.mark.parametrize("name", ["net/../../etc/passwd", "net\\data\\0", "/net", "net/data.pkl"])
def test_a_member_with_a_tricky_name_is_refused(tmp_path, name):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *a, **k: None)  # zipfile's own, of the doubled name
        path = pth(tmp_path / "a.pth", saved(), members={name: b"x"})
    assert "has a name that torch.save does not give" in refusal(path)


def test_members_in_two_folders_are_refused(tmp_path):
    path = pth(tmp_path / "a.pth", saved(), members={"other/version": b"x"})
    assert refusal(path) == "its members lie in several folders; torch.save makes one"


def test_a_huge_pickle_is_refused_unread(tmp_path):
    path = pth(tmp_path / "a.pth", saved(), pickled=bytes((1 << 20) + 1))
    assert refusal(path) == "member data.pkl has 1048577 bytes, at most 1048576 are read"


# Networks that do not fit together


def without(state, name):
    return OrderedDict((k, v) for k, v in state.items() if k != name)


def with_(state, **tensors):
    return OrderedDict(state, **{k.replace("__", "."): v for k, v in tensors.items()})


GOOD = layers(20, 4, 1)
NAN = GOOD["layer0.weight"].array.copy()
NAN[1, 2] = np.nan


@pytest.mark.parametrize(
    ("held", "text"),
    [
        (
            saved(layers(19, 4, 1), scaler_X=scaler(np.zeros(19), np.ones(19))),
            "its first layer takes 19 inputs; the released format has 20, unnamed",
        ),
        (
            saved(with_(GOOD, layer1__weight=Tensor(np.ones((1, 5))))),
            "layer 'layer1' takes 5 numbers, the one before gives 4",
        ),
        (saved(layers(20, 4, 2)), "its last layer gives 2 numbers; a magnetometer gives 1"),
        (saved(without(GOOD, "layer0.bias")), "layer 'layer0' has no bias"),
        (
            saved(with_(GOOD, layer0__weight=Tensor(np.ones(20)))),
            "layer 'layer0' is not linear: weight (20,), bias (4,)",
        ),
        (
            saved(with_(GOOD, norm__running_mean=Tensor(np.ones(4)))),
            "tensor 'norm.running_mean' is neither weight nor bias of a linear layer",
        ),
        (
            saved(with_(GOOD, layer0__weight=Tensor(NAN))),
            "tensor 'layer0.weight' has 1 numbers that are nan or infinite",
        ),
        (saved(with_(GOOD, layer0__weight=3)), "'layer0.weight' is not a tensor of numbers"),
        (saved(OrderedDict()), "model_state_dict holds no tensors"),
        (
            saved(scaler_X=None),
            "no 'scaler_X' in it, only 'model_state_dict', 'scaler_y'; "
            "a checkpoint has model_state_dict, scaler_X and scaler_y",
        ),
        (saved(scaler_X={}), "scaler_X is not a StandardScaler"),
        (
            saved(scaler_X=scaler(np.zeros(4), np.ones(4))),
            "scaler_X is for 4 inputs, the first layer for 20",
        ),
        (saved(scaler_y=scaler([0, 0], [1, 1])), "scaler_y is for 2 labels; a magnetometer has 1"),
        (
            saved(scaler_X=scaler(np.zeros(20), np.zeros(20))),
            "scaler_X has a mean that is not finite, or a scale that is not above 0",
        ),
        (
            saved(scaler_y=scaler([1], [np.nan])),
            "scaler_y has a mean that is not finite, or a scale that is not above 0",
        ),
        (saved(scaler_y=StandardScaler()), "scaler_y is not a StandardScaler"),
        (
            saved(scaler_X=scaler(np.zeros((2, 2)), np.ones((2, 2)))),
            "scaler_X has (2, 2) means and (2, 2) scales",
        ),
    ],
)
def test_a_network_that_does_not_fit_together_is_refused(tmp_path, held, text):
    assert refusal(pth(tmp_path / "a.pth", held)) == text


def test_a_tensor_that_reaches_beyond_its_storage_is_refused(tmp_path):
    path = pth(tmp_path / "a.pth", saved())
    replace(path, {"net/data/0": GOOD["layer0.weight"].array.tobytes()[:-4]})
    assert refusal(path) == "tensor 'layer0.weight' reaches beyond the 79 numbers of data/0"


def test_a_tensor_that_repeats_one_number_without_end_is_refused(tmp_path):
    class Endless(Tensor):
        """Strides of 0: one stored number stands for 10^12."""

    def reduce(self, obj, plain=Saver.reducer_override):
        if isinstance(obj, Endless):
            self.storages.append(b"\0\0\0\0")
            key = str(len(self.storages) - 1)
            return Rebuild, (Stored(key, 1), 0, (10**6, 10**6), (0, 0), False, OrderedDict())
        return plain(self, obj)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Saver, "reducer_override", reduce)
        path = pth(tmp_path / "a.pth", saved(with_(GOOD, layer0__weight=Endless(0))))
    assert refusal(path) == "tensor 'layer0.weight' reaches beyond the 1 numbers of data/0"
