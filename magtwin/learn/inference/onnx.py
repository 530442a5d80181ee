"""ONNX: a predictor as one graph that runs in onnxruntime without torch and without magtwin.

The input is float64 features in their units, as `magtwin.learn.data.features` makes them; the outputs are the
disturbance and the standard deviation of its error [nT], each (rows,). Other programs run it on robots that
it was not trained on, so a predictor that has a `wide` spread gives that. Scalers are inside the graph and
work in float64, because float32 would err by 0.1 nT; products are float32, as in torch.
"""

import json
import math
import os
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.budget import check_count
from magtwin.files.file import read_bytes, sha256
from magtwin.files.outputs import check_free, output
from magtwin.files.protobuf import fields
from magtwin.learn.data.features import FEATURES
from magtwin.learn.data.inputs import Inputs
from magtwin.learn.mixed.mixed import Mixed
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.hybrid import Hybrid
from magtwin.learn.models.linear import Linear
from magtwin.learn.models.network import FieldNet
from magtwin.learn.models.predictor import Predictor, load_predictor
from magtwin.report.report import Figure, Report
from magtwin.version import __version__

if TYPE_CHECKING:
    import onnx

OPSET = 17  # Version of ONNX's operators; runtimes of 2022 and later have them
IR_VERSION = 8  # Version of the file's own form, as old as the operators

METADATA, OPSETS = 14, 8  # Fields of a ModelProto that tell what it is
INPUT = "features"
MEAN = "disturbance_nt"
SD = "sd_nt"

AGREES_NT = 1e-3  # Largest difference between onnxruntime and torch [nT], beside rounding
ROUNDING = 1e-6  # Relative rounding of a float32 sum of products
PROBE = 512  # Rows on which that is checked before a file is written

NO_TELEMETRY = "ORT_DISABLE_TELEMETRY"
"""Variable that keeps onnxruntime from writing telemetry into TMPDIR and the user's cache."""

EXTRA = "onnx and onnxruntime are not both installed: pip install 'magtwin[onnx]'"


def export_onnx(
    weights: str | os.PathLike[str], out: str | os.PathLike[str], *, force: bool = False
) -> Report:
    """Write the predictor of a weights file as ONNX, after checking that onnxruntime agrees with torch.

    The same weights give the same bytes.

    Args:
        weights: Weights file of any kind, .safetensors or .pth.
        out: The file to write.
        force: Replace an existing file.

    Returns:
        What the file holds, and the largest difference from torch.

    Raises:
        InputError: No such weights, a package is missing, onnxruntime differs, or `out` exists.
    """
    check_free(out, force=force)
    predictor = load_predictor(weights)
    model = model_of(predictor, weights_sha256=sha256(weights))
    data = model.SerializeToString(deterministic=True)
    worst = _difference_nt(predictor, data, weights)
    with output(out, force=force) as aside:
        aside.write_bytes(data)
    report = _report(model, str(out))
    difference = Figure("largest difference", worst, "nT", note=f"from torch, of {PROBE} rows")
    return Report(report.title, (*report.figures, difference), report.metadata)


def report_onnx(path: str | os.PathLike[str]) -> Report:
    """Read the metadata of an ONNX file that magtwin wrote, without running it.

    Raises:
        InputError: No such file, damaged, not written by magtwin, or onnx is not installed.
    """
    data = read_bytes(path, "ONNX file", "ONNX")
    onnx = _onnx()
    try:
        model = onnx.ModelProto.FromString(_without_graph(data, path))
    except Exception as error:  # protobuf's own kinds of error
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: no ONNX file, or damaged; export it again") from error
    try:
        return _report(model, str(path))
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path}: ONNX, but no network of magtwin's: its metadata lack features and units"
        ) from error


def model_of(predictor: Predictor, *, weights_sha256: str = "") -> "onnx.ModelProto":
    """The graph of a predictor of magtwin's kinds, with its metadata."""
    onnx = _onnx()
    graph = _Graph(onnx)
    mean, sd = graph.predictor(predictor)
    graph.add("Identity", mean, out=MEAN)
    graph.add("Identity", sd, out=SD)
    double, inputs = onnx.TensorProto.DOUBLE, predictor.inputs
    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            "magtwin",
            [onnx.helper.make_tensor_value_info(INPUT, double, ["rows", len(inputs.features)])],
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
    properties: dict[str, Any] = {
        "kind": predictor.kind,
        "layers": predictor.layers_text,
        "parameters": predictor.parameters_count,
        "features": inputs.features,
        "units": [FEATURES[name].unit for name in inputs.features],
        "training_min": _known(inputs.low),
        "training_max": _known(inputs.high),
        "output_unit": "nT",
        "residual_sd_nt": None if math.isnan(sd_nt) else sd_nt,
        "weights_sha256": weights_sha256,
        "facts": predictor.metadata,
    }
    for key, value in properties.items():
        text = value if isinstance(value, str) else json.dumps(value, sort_keys=True, allow_nan=False)
        model.metadata_props.add(key=key, value=text)
    return model


class _Graph:
    """Nodes and constants of a graph; values are referred to by name."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, values: Any) -> str:
        """Add an array; returns its name."""
        name = f"c{len(self.constants)}"
        self.constants.append(self._onnx.numpy_helper.from_array(np.array(values, order="C"), name))
        return name

    def add(self, operator: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        """Add an operator; returns the name of its output."""
        out = out or f"v{len(self.nodes)}"
        self.nodes.append(self._onnx.helper.make_node(operator, inputs, [out], **attributes))
        return out

    def predictor(self, predictor: Predictor) -> tuple[str, str]:
        """Disturbance and standard deviation [nT], each (rows,)."""
        if isinstance(predictor, FieldNet):
            mean = self.net(predictor, INPUT)
            if predictor.wide:
                return mean, self.sd(predictor.wide, self.scaled(predictor.inputs, INPUT))
            sd = self.constant([predictor.residual_sd_nt])
            return mean, self.add("Expand", sd, self.add("Shape", mean))
        if isinstance(predictor, Linear):
            return self.linear(predictor, predictor.wide or predictor.spread)
        if isinstance(predictor, Mixed):
            nominal = predictor.intervals == "nominal"
            return self.mixed(predictor.open_loop(unknown_plant=True) if nominal else predictor)
        if isinstance(predictor, Hybrid):
            known = predictor.base.spread.scaled(predictor.sd_factor)
            mean, sd = self.linear(predictor.base, predictor.wide or known)
            if predictor.net is not None:
                inputs = predictor.base.inputs
                clipped = self.add("Max", INPUT, self.constant(inputs.low))
                clipped = self.add("Min", clipped, self.constant(inputs.high))
                mean = self.add("Add", mean, self.net(predictor.net, clipped))
            return mean, sd
        raise InputError(f"a predictor of the kind {predictor.kind!r} has no ONNX graph")

    def scaled(self, inputs: Inputs, x: str) -> str:
        """Scaled inputs (rows, F), float64."""
        centred = self.add("Sub", x, self.constant(inputs.mean))
        return self.add("Div", centred, self.constant(inputs.scale))

    def net(self, net: FieldNet, x: str) -> str:
        """Disturbance of a multilayer perceptron, (rows,)."""
        z = self.scaled(net.inputs, x)
        h = self.add("Cast", z, to=self._onnx.TensorProto.FLOAT)
        for i, layer in enumerate(net.layers):
            weight, bias = (self.constant(part) for part in layer)
            h = self.add("Gemm", h, weight, bias, transB=1)
            h = self.add("Relu", h) if i < len(net.layers) - 1 else h
        column = self.add("Gather", h, self.constant(np.array(0)), axis=1)
        y = self.add("Cast", column, to=self._onnx.TensorProto.DOUBLE)
        y = self.add("Mul", y, self.constant(float(net.y_scale)))
        y = self.add("Add", y, self.constant(float(net.y_mean)))
        # nan of any input, because a runtime's ReLU may turn nan into 0
        nan = self.add("ReduceSum", self.add("Sub", z, z), self.constant(np.array([1])), keepdims=0)
        return self.add("Add", y, nan)

    def affine(self, z: str, slopes: Any, constant: Any) -> str:
        """Scaled inputs times slopes, and a constant, (rows,)."""
        return self.add("Add", self.add("MatMul", z, self.constant(slopes)), self.constant(constant))

    def linear(self, linear: Linear, spread: Spread) -> tuple[str, str]:
        """Disturbance and standard deviation of a linear model, each (rows,)."""
        z = self.scaled(linear.inputs, INPUT)
        return self.affine(z, linear.coefficients_nt, linear.constant_nt), self.sd(spread, z)

    def mixed(self, mixed: Mixed) -> tuple[str, str]:
        """Disturbance and standard deviation of a mixed model, each (rows,)."""
        z, effects = self.scaled(mixed.inputs, INPUT), mixed.session
        mean = self.affine(z, effects.mean[1:], effects.mean[0])
        factor, share = mixed.interval_factors
        cross = self.add("MatMul", z, self.constant(effects.covariance[1:, 1:]))
        cross = self.add("Mul", self.add("Add", cross, self.constant(2 * effects.covariance[0, 1:])), z)
        variance = self.add("ReduceSum", cross, self.constant(np.array([1])), keepdims=0)
        variance = self.add("Add", variance, self.constant(effects.covariance[0, 0]))
        variance = self.add("Mul", variance, self.constant(share))
        variance = self.add("Add", variance, self.constant(mixed.hidden_nt2))
        variance = self.add("Add", variance, self.variance(mixed.noise, z))
        return mean, self.add("Mul", self.add("Sqrt", variance), self.constant(factor))

    def sd(self, spread: Spread, z: str) -> str:
        """Standard deviation of a spread at scaled inputs, (rows,)."""
        return self.add("Sqrt", self.variance(spread, z))

    def variance(self, spread: Spread, z: str) -> str:
        """Variance of a spread at scaled inputs, (rows,)."""
        return self.affine(self.add("Mul", z, z), spread.slopes_nt2, spread.floor_nt2)


def _without_graph(data: bytes, where: object) -> bytes:
    """The metadata of a serialized `ModelProto`: the nodes of its graph could take 50 times their size.

    Raises:
        InputError: There are too many of them.
        ValueError: It is damaged.
    """
    about = [data[begin:end] for field, _, begin, end in fields(data) if field in (METADATA, OPSETS)]
    check_count(where, "ONNX", len(about), "entries of metadata")
    return b"".join(about)


def _report(model: Any, title: str) -> Report:
    properties = {entry.key: entry.value for entry in model.metadata_props}
    names, units, metadata, low, high = (
        json.loads(properties[key]) for key in ("features", "units", "facts", "training_min", "training_max")
    )
    ranges = {}
    for name, unit, least, most in zip(names, units, low, high, strict=True):
        known = "" if least is None or most is None else f"  trained from {least:g} to {most:g}"
        ranges[name] = f"{unit or '-'}{known}"
    figures = [
        Figure("kind", properties["kind"]),
        Figure("layers", properties["layers"]),
        Figure("parameters", int(properties["parameters"])),
        Figure("opset", max(entry.version for entry in model.opset_import)),
        Figure("input", f"{INPUT} (rows, {len(names)}), float64"),
        Figure("outputs", f"{MEAN} and {SD} (rows,), float64, nT"),
    ]
    if (sd := json.loads(properties["residual_sd_nt"])) is not None:
        figures.append(Figure("residual sd", float(sd), "nT", note="on held-out runs"))
    about = {"weights_sha256": properties["weights_sha256"], **metadata, "features": ranges}
    return Report(title, tuple(figures), about)


def _known(values: NDArray[np.float64]) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]


def _difference_nt(predictor: Predictor, data: bytes, weights: str | os.PathLike[str]) -> float:
    """Largest difference between onnxruntime and the predictor [nT], on rows around the training rows."""
    os.environ.setdefault(NO_TELEMETRY, "1")  # before the import, which writes its files
    try:
        import onnxruntime
    except ImportError:
        raise InputError(EXTRA) from None
    inputs = predictor.inputs
    wave = np.sin(np.arange(PROBE * len(inputs.features), dtype=float)).reshape(PROBE, -1)
    x = inputs.mean + 2 * inputs.scale * wave
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    exported = np.nan_to_num(session.run([MEAN, SD], {INPUT: x}))
    (mean, sd), wide = predictor.predict(x), predictor.wide_sd_nt(x)
    expected = np.nan_to_num((mean, sd if wide is None else wide))
    difference = np.abs(exported - expected)
    worst = float(difference.max())
    if not np.all(difference <= AGREES_NT + ROUNDING * np.abs(expected)):
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
