"""ONNX: a predictor as one graph that runs wherever onnxruntime does, without torch and without magtwin.

In go features in their units and in float64, as `magtwin.learn.data.features` gives them; out come the
disturbance
and the standard deviation of its error [nT], each (rows,). Scalers are inside and work in float64, because in
float32 they would err by 0.1 nT; products are float32, as in torch. A file's metadata tell what it holds.

A temporal network looks at earlier rows: `context` of them, `step_s` apart as all rows are, stand before the
first row that is wanted, and outputs are by as many fewer. Before a run's first row it stood as in it; where
an earlier row holds a nan, the last whole one stands in its place.
"""

import json
import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files import check_free, existing, output, sha256
from magtwin.learn.data.features import FEATURES
from magtwin.learn.data.inputs import Inputs
from magtwin.learn.models import heads
from magtwin.learn.models.ensemble import Ensemble
from magtwin.learn.models.hybrid import Hybrid
from magtwin.learn.models.linear import Linear
from magtwin.learn.models.network import FieldNet
from magtwin.learn.models.perceptron import Layer
from magtwin.learn.models.predictor import Predictor, load_predictor
from magtwin.learn.models.temporal import Temporal
from magtwin.report import Figure, Report
from magtwin.version import __version__

if TYPE_CHECKING:
    import onnx

OPSET = 17
"""Version of ONNX's operators; runtimes of 2022 and later have them."""

IR_VERSION = 8
"""Version of the file's own form, as old as the operators."""

INPUT = "features"
MEAN = "disturbance_nt"
SD = "sd_nt"

AGREES_NT = 1e-3
"""How far from torch what onnxruntime gives may be [nT], beside its rounding."""

ROUNDING = 1e-6
"""What float32 may be off in a sum of products, of its size: 0.001 nT of 1,000 nT."""

PROBE = 512
"""Rows on which that is checked before a file is written."""

EXTRA = "onnx and onnxruntime are not both installed: pip install 'magtwin[onnx]'"


def export_onnx(
    weights: str | os.PathLike[str], out: str | os.PathLike[str], *, force: bool = False
) -> Report:
    """Write the predictor of a weights file as ONNX, if onnxruntime then gives what torch gives.

    The same weights give the same bytes.

    Args:
        weights: Weights file of any kind, .safetensors or .pth.
        out: The file to write.
        force: Whether one that exists is replaced.

    Returns:
        What the file holds, and the largest difference from torch that was seen.

    Raises:
        InputError: No such weights, packages that are missing, onnxruntime differs, or `out` exists.
    """
    check_free(out, force=force)
    predictor = load_predictor(weights)
    model = model_of(predictor, weights_sha256=sha256(weights))
    data = model.SerializeToString(deterministic=True)
    worst = _difference_nt(predictor, data, weights)
    with output(out, force=force) as aside:
        aside.write_bytes(data)
    found = _report(model, str(out))
    difference = Figure("largest difference", worst, "nT", note=f"from torch, of {PROBE} rows")
    return Report(found.title, (*found.figures, difference), found.metadata)


def report_onnx(path: str | os.PathLike[str]) -> Report:
    """What an ONNX file of magtwin's holds; nothing of it is run, nor is a file that it names opened.

    Raises:
        InputError: No such file, damaged, not of magtwin's, or onnx is not installed.
    """
    path = existing(path, "ONNX file")
    if path.is_dir():
        raise InputError(f"{path}: a folder; give an ONNX file")
    onnx = _onnx()
    try:
        model = onnx.ModelProto.FromString(path.read_bytes())
    except Exception as error:  # protobuf's own, of a package that is not ours
        raise InputError(f"{path}: no ONNX file, or damaged; export it again") from error
    try:
        return _report(model, str(path))
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path}: ONNX, but no network of magtwin's: its metadata do not tell features and units"
        ) from error


def model_of(predictor: Predictor, *, weights_sha256: str = "") -> "onnx.ModelProto":
    """The graph of a predictor, with its metadata.

    Args:
        predictor: Of any kind that a weights file holds.
        weights_sha256: Checksum of its weights file, for the metadata.

    Raises:
        InputError: Another kind, or onnx is not installed.
    """
    onnx = _onnx()
    graph = _Graph(onnx)
    mean, sd = graph.predictor(predictor)
    graph.add("Identity", mean, out=MEAN)
    graph.add("Identity", sd, out=SD)
    double, of = onnx.TensorProto.DOUBLE, inputs_of(predictor)
    rows = f"rows + {predictor.context}" if predictor.context else "rows"
    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            "magtwin",
            [onnx.helper.make_tensor_value_info(INPUT, double, [rows, len(of.features)])],
            [onnx.helper.make_tensor_value_info(name, double, ["rows"]) for name in (MEAN, SD)],
            graph.constants,
        ),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="magtwin",
        producer_version=__version__,
        doc_string="Disturbance of the field's magnitude at a robot's magnetometer [nT]",
    )
    sd_nt = predictor.residual_sd_nt
    told: dict[str, Any] = {
        "kind": predictor.kind,
        "layers": predictor.layers_text,
        "parameters": predictor.parameters_count,
        "features": of.features,
        "units": [FEATURES[name].unit for name in of.features],
        "training_min": _known(of.low),
        "training_max": _known(of.high),
        "output_unit": "nT",
        "residual_sd_nt": None if math.isnan(sd_nt) else sd_nt,
        "context": predictor.context,
        "step_s": predictor.step_s,
        "weights_sha256": weights_sha256,
        "facts": predictor.metadata,
    }
    for key, value in told.items():
        text = value if isinstance(value, str) else json.dumps(value, sort_keys=True, allow_nan=False)
        model.metadata_props.add(key=key, value=text)
    return model


def inputs_of(predictor: Predictor) -> Inputs:
    """Scaler and training ranges of a predictor's inputs.

    Raises:
        InputError: A kind that has no graph.
    """
    if isinstance(predictor, Hybrid):
        return predictor.base.inputs
    if isinstance(predictor, FieldNet | Linear | Ensemble | Temporal):
        return predictor.inputs
    raise InputError(f"a predictor of the kind {predictor.kind!r} has no ONNX graph")


class _Graph:
    """Nodes and constants of a graph on their way; values go by their names."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, values: Any) -> str:
        """The name of an array."""
        name = f"c{len(self.constants)}"
        self.constants.append(self._onnx.numpy_helper.from_array(np.array(values, order="C"), name))
        return name

    def add(self, operator: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        """The name of what an operator gives."""
        out = out or f"v{len(self.nodes)}"
        self.nodes.append(self._onnx.helper.make_node(operator, inputs, [out], **attributes))
        return out

    def predictor(self, predictor: Predictor) -> tuple[str, str]:
        """Disturbance and standard deviation [nT], each (rows,)."""
        if isinstance(predictor, FieldNet):
            mean = self.net(predictor, INPUT)
            sd = self.constant([predictor.residual_sd_nt])
            return mean, self.add("Expand", sd, self.add("Shape", mean))
        if isinstance(predictor, Linear):
            return self.linear(predictor)
        if isinstance(predictor, Hybrid):
            mean, sd = self.linear(predictor.base)
            if predictor.net is not None:
                of = predictor.base.inputs
                held = self.add("Max", INPUT, self.constant(of.low))
                held = self.add("Min", held, self.constant(of.high))
                mean = self.add("Add", mean, self.net(predictor.net, held))
            return mean, self.add("Mul", sd, self.constant(predictor.sd_factor))
        if isinstance(predictor, Ensemble):
            return self.ensemble(predictor)
        if isinstance(predictor, Temporal):
            return self.temporal(predictor)
        raise InputError(f"a predictor of the kind {predictor.kind!r} has no ONNX graph")

    def scaled(self, inputs: Inputs, x: str) -> str:
        """Scaled inputs (rows, F), float64."""
        centred = self.add("Sub", x, self.constant(inputs.mean))
        return self.add("Div", centred, self.constant(inputs.scale))

    def net(self, net: FieldNet, x: str) -> str:
        """Disturbance of a multilayer perceptron (rows,)."""
        z = self.scaled(net.inputs, x)
        out = self.column(self.layers([(one.weight, one.bias) for one in net.linears], z), 0)
        y = self.add("Mul", out, self.constant(float(net.y_scale)))
        return self.nan_of(z, self.add("Add", y, self.constant(float(net.y_mean))))

    def linear(self, linear: Linear) -> tuple[str, str]:
        """Disturbance and standard deviation of a linear model, each (rows,)."""
        z = self.scaled(linear.inputs, INPUT)
        mean = self.add("MatMul", z, self.constant(linear.coefficients_nt))
        mean = self.add("Add", mean, self.constant(linear.constant_nt))
        variance = self.add("MatMul", self.add("Mul", z, z), self.constant(linear.spread.slopes_nt2))
        variance = self.add("Add", variance, self.constant(linear.spread.floor_nt2))
        return mean, self.add("Sqrt", variance)

    def ensemble(self, ensemble: Ensemble) -> tuple[str, str]:
        """Mean of the members, and the standard deviation of what each says and of how they differ."""
        z = self.scaled(ensemble.inputs, INPUT)
        means, variances = [], []
        for i in range(ensemble.net.members):
            out = self.layers(ensemble.member(i), z)
            mean, variance = self.moments(out, 0.0, ensemble.y_scale_nt)
            means.append(mean)
            variances.append(variance)
        mean, own = self.average(means), self.average(variances)
        apart = [self.add("Sub", one, mean) for one in means]
        between = self.average([self.add("Mul", one, one) for one in apart])
        sd = self.add("Sqrt", self.add("Add", own, between))
        mean = self.add("Add", mean, self.constant(ensemble.y_mean_nt))
        sd = self.add("Mul", sd, self.constant(ensemble.sd_factor))
        return self.nan_of(z, mean), self.nan_of(z, sd)

    def temporal(self, temporal: Temporal) -> tuple[str, str]:
        """What causal convolutions give of every row but the first `context`."""
        of, kernel = self.scaled(temporal.inputs, INPUT), temporal.net.kernel
        z, width = self.add("Cast", of, to=self._onnx.TensorProto.FLOAT), len(temporal.features)
        for i, layer in enumerate(temporal.net.layers):
            assert isinstance(layer, torch.nn.Linear)
            back = [(kernel - 1 - k) * 2**i for k in range(kernel)]
            taps = [self.rows(z, back[0] - behind, behind) for behind in back]
            h = self.gemm(self.add("Concat", *taps, axis=1), (layer.weight, layer.bias))
            h = self.add("Relu", h)
            z = self.add("Add", h, taps[-1]) if len(layer.bias) == width else h
            width = len(layer.bias)
        last = temporal.net.last
        mean, variance = self.moments(
            self.gemm(z, (last.weight, last.bias)), temporal.y_mean_nt, temporal.y_scale_nt
        )
        sd = self.add("Mul", self.add("Sqrt", variance), self.constant(temporal.sd_factor))
        now = self.rows(of, temporal.context, 0)
        return self.nan_of(now, mean), self.nan_of(now, sd)

    def moments(self, out: str, y_mean: float, y_scale: float) -> tuple[str, str]:
        """Mean and variance of two heads, each (rows,), as `magtwin.learn.models.heads.moments`."""
        mean = self.add("Mul", self.column(out, 0), self.constant(y_scale))
        mean = self.add("Add", mean, self.constant(y_mean))
        low, high = self.constant(-heads.LIMIT), self.constant(heads.LIMIT)
        spread = self.add("Exp", self.add("Clip", self.column(out, 1), low, high))
        return mean, self.add("Mul", spread, self.constant(y_scale**2))

    def layers(self, layers: Sequence[Layer], z: str) -> str:
        """What layers with ReLU between them give (rows, K), float32."""
        h = self.add("Cast", z, to=self._onnx.TensorProto.FLOAT)
        for i, layer in enumerate(layers):
            h = self.gemm(h, layer)
            h = self.add("Relu", h) if i < len(layers) - 1 else h
        return h

    def gemm(self, h: str, layer: Layer) -> str:
        """A layer without its ReLU."""
        weight, bias = (self.constant(part.detach().numpy()) for part in layer)
        return self.add("Gemm", h, weight, bias, transB=1)

    def average(self, values: Sequence[str]) -> str:
        """The mean of several values; onnxruntime has no operator Mean in float64."""
        total = values[0]
        for one in values[1:]:
            total = self.add("Add", total, one)
        return self.add("Div", total, self.constant(float(len(values))))

    def column(self, values: str, index: int) -> str:
        """A column of float32 (rows, K) as float64 (rows,)."""
        one = self.add("Gather", values, self.constant(np.array(index)), axis=1)
        return self.add("Cast", one, to=self._onnx.TensorProto.DOUBLE)

    def rows(self, values: str, first: int, left: int) -> str:
        """Rows from `first` on, without the last `left`."""
        stop = -left if left else np.iinfo(np.int64).max
        bounds = (self.constant(np.array([at])) for at in (first, stop, 0))
        return self.add("Slice", values, *bounds)

    def nan_of(self, z: str, values: str) -> str:
        """Values (rows,) that are nan where an input (rows, F) is: a runtime's ReLU may make 0 of it."""
        nothing = self.add("ReduceSum", self.add("Sub", z, z), self.constant(np.array([1])), keepdims=0)
        return self.add("Add", values, nothing)


def _report(model: Any, title: str) -> Report:
    told = {one.key: one.value for one in model.metadata_props}
    names, units, metadata, low, high, context, step_s = (
        json.loads(told[key])
        for key in ("features", "units", "facts", "training_min", "training_max", "context", "step_s")
    )
    ranges = {}
    for name, unit, least, most in zip(names, units, low, high, strict=True):
        known = "" if least is None or most is None else f"  trained from {least:g} to {most:g}"
        ranges[name] = f"{unit or '-'}{known}"
    figures = [
        Figure("kind", told["kind"]),
        Figure("layers", told["layers"]),
        Figure("parameters", int(told["parameters"])),
        Figure("opset", max(one.version for one in model.opset_import)),
        Figure("input", f"{INPUT} (rows{f' + {context}' if context else ''}, {len(names)}), float64"),
        Figure("outputs", f"{MEAN} and {SD} (rows,), float64, nT"),
    ]
    if context:
        figures.append(Figure("rows back", context, note=f"{step_s:g} s apart"))
    if (sd := json.loads(told["residual_sd_nt"])) is not None:
        figures.append(Figure("residual sd", float(sd), "nT", note="on held-out runs"))
    return Report(
        title, tuple(figures), {"weights_sha256": told["weights_sha256"], **metadata, "features": ranges}
    )


def _known(values: NDArray[np.float64]) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


def _difference_nt(predictor: Predictor, data: bytes, weights: str | os.PathLike[str]) -> float:
    """Largest difference between onnxruntime and the predictor itself [nT], on rows about the training's."""
    try:
        import onnxruntime
    except ImportError:
        raise InputError(EXTRA) from None
    of = inputs_of(predictor)
    wave = np.sin(np.arange(PROBE * len(of.features), dtype=float)).reshape(PROBE, -1)
    x = of.mean + 2 * of.scale * wave
    before = np.repeat(x[:1], predictor.context, axis=0)
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    found = np.nan_to_num(session.run([MEAN, SD], {INPUT: np.concatenate([before, x])}))
    wanted = np.nan_to_num(predictor.predict(x))
    difference = np.abs(found - wanted)
    worst = float(difference.max())
    if not np.all(difference <= AGREES_NT + ROUNDING * np.abs(wanted)):
        raise InputError(
            f"{weights}: onnxruntime here differs from torch by {worst:.2g} nT; install another version of it"
        )
    return worst


def _onnx() -> Any:
    try:
        import onnx
    except ImportError:
        raise InputError(EXTRA) from None
    return onnx
