"""A model that classifies by colour: input by its spec, output as classes, and errors."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import yaml
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from semloc_logs.errors import SettingsError
from semloc_logs.labels.segmentation import Segmenter, fingerprint
from semloc_logs.labels.segmentation_spec import read_spec
from semloc_logs.labels.space import UNPAINTED
from semloc_logs.settings import Labels

ROAD, VEGETATION, CAR = 0, 8, 13
Pixels = NDArray[np.uint8]


def save_model(
    path: Path,
    rows: int = 8,
    columns: int = 16,
    nhwc: bool = False,
    ids: bool = False,
    classes: int = 3,
    times: int = 1,
    plus: int = 0,
) -> Path:
    """Class k of three is the brightest channel, with id ``times`` k ``plus`` a number."""
    weights = np.zeros((classes, 3, 1, 1), np.float32)
    weights[:3, :, 0, 0] = np.eye(3)
    bias = np.where(np.arange(classes) < 3, 0, -100).astype(np.float32)
    shape = [1, rows, columns, 3] if nhwc else [1, 3, rows, columns]
    nodes = [helper.make_node("Transpose", ["x"], ["t"], perm=[0, 3, 1, 2])] if nhwc else []
    nodes.append(
        helper.make_node("Conv", ["t" if nhwc else "x", "w", "b"], ["c" if ids or nhwc else "y"])
    )
    out = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, classes, rows, columns])
    if ids:
        nodes.append(helper.make_node("ArgMax", ["c"], ["k"], axis=1, keepdims=0))
        nodes += [
            helper.make_node("Mul", ["k", "times"], ["m"]),
            helper.make_node("Add", ["m", "plus"], ["y"]),
        ]
        out = helper.make_tensor_value_info("y", TensorProto.INT64, [1, rows, columns])
    elif nhwc:
        nodes.append(helper.make_node("Transpose", ["c"], ["y"], perm=[0, 2, 3, 1]))
        out = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, rows, columns, classes])
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)
    numbers = [
        numpy_helper.from_array(np.array(n, np.int64), name)
        for n, name in ((times, "times"), (plus, "plus"))
    ]
    stored = [
        *(numbers if ids else []),
        numpy_helper.from_array(weights, "w"),
        numpy_helper.from_array(bias, "b"),
    ]
    model = helper.make_model(
        helper.make_graph(nodes, "by colour", [x], [out], stored),
        opset_imports=[helper.make_opsetid("", 13)],
    )
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


def opened(folder: Path, model: dict[str, Any] | None = None, **spec: Any) -> Segmenter:
    content: dict[str, Any] = {
        "input": {"size": [8, 16]},
        "classes": ["road", "vegetation", "car"],
    } | spec
    file = folder / "spec.yaml"
    file.write_text(yaml.safe_dump(content))
    path = save_model(folder / "model.onnx", **(model or {}))
    return Segmenter.open(Labels(source="onnx", model=path, spec=file))


def stripes(rows: int = 8, columns: int = 16) -> Pixels:
    """Red on the left, green in the middle, blue on the right."""
    image = np.zeros((rows, columns, 3), np.uint8)
    for k in range(3):
        image[:, k * columns // 3 : (k + 1) * columns // 3, k] = 200
    return image


def test_classes_by_colour(tmp_path: Path) -> None:
    segmenter = opened(tmp_path)
    ids = segmenter.train_ids(stripes())
    assert ids[3].tolist() == [ROAD] * 5 + [VEGETATION] * 5 + [CAR] * 6
    np.testing.assert_array_equal(ids, segmenter.train_ids(stripes()))
    assert segmenter.to_json()["runtime"].startswith("onnxruntime")


@pytest.mark.parametrize("nhwc", [False, True])
@pytest.mark.parametrize("ids", [False, True])
def test_layouts_and_ids(tmp_path: Path, nhwc: bool, ids: bool) -> None:
    model = {"nhwc": nhwc, "ids": ids}
    spec_in = {"size": [8, 16], "layout": "NHWC" if nhwc else "NCHW"}
    spec_out = {"kind": "ids"} if ids else {"layout": "HWC" if nhwc else "CHW"}
    assert opened(tmp_path, model, input=spec_in, output=spec_out).train_ids(stripes())[
        0, ::5
    ].tolist() == [ROAD, VEGETATION, CAR, CAR]


def test_ids_that_models_give_to_nothing_are_unlabelled(tmp_path: Path) -> None:
    less = opened(tmp_path, {"ids": True, "plus": -1}, output={"kind": "ids"})
    assert less.train_ids(stripes())[0, ::5].tolist() == [255, ROAD, VEGETATION, VEGETATION]
    image = stripes()
    image[:, 10:] = image[:, 9:10]  # no third class, which would be 510
    many = opened(tmp_path, {"ids": True, "times": 255}, output={"kind": "ids"})
    assert many.train_ids(image)[0, ::5].tolist() == [ROAD, 255, 255, 255]
    with pytest.raises(SettingsError, match="gives the class 510"):
        many.train_ids(stripes())


@pytest.mark.parametrize(
    "output",
    [np.zeros((1, 3, 0, 16), np.float32), np.full((1, 8, 16), "road"), np.full((3, 8, 16), None)],
)
@pytest.mark.parametrize("kind", ["ids", "logits"])
def test_outputs_that_are_no_pictures_are_refused(
    tmp_path: Path, output: NDArray[Any], kind: str
) -> None:
    opened(tmp_path, output={"kind": kind})
    file = tmp_path / "spec.yaml"
    segmenter = Segmenter(lambda _: output, "none", read_spec(file), file, tmp_path / "model.onnx")
    with pytest.raises(SettingsError, match="values of type"):
        segmenter.train_ids(stripes())


def test_colour_order_mean_and_scale(tmp_path: Path) -> None:
    backwards = opened(tmp_path, input={"size": [8, 16], "colours": "BGR"})
    assert backwards.train_ids(stripes())[0, ::5].tolist() == [CAR, VEGETATION, ROAD, ROAD]
    # red 0.78 - 0.9 < 0 = green: the means are in the order of the channels
    shifted = opened(tmp_path, input={"size": [8, 16], "mean": [0.9, 0.0, 0.0]})
    assert shifted.train_ids(stripes())[0, 0] == VEGETATION
    negative = opened(tmp_path, input={"size": [8, 16], "scale": -1.0})
    assert negative.train_ids(stripes())[0, 0] in (VEGETATION, CAR)


def test_pictures_of_other_sizes_come_back_in_their_own(tmp_path: Path) -> None:
    stretched = opened(tmp_path).train_ids(stripes(40, 48))
    assert stretched.shape == (40, 48)
    assert stretched[20, [2, 24, 46]].tolist() == [ROAD, VEGETATION, CAR]
    tall = stripes(64, 16)
    boxed = opened(tmp_path, input={"size": [8, 16], "resize": "letterbox"}).train_ids(
        stripes(32, 32)
    )
    assert boxed[16, [2, 16, 29]].tolist() == [ROAD, VEGETATION, CAR]
    assert opened(tmp_path, input={"size": [8, 16], "resize": "letterbox"}).train_ids(
        tall
    ).shape == (64, 16)
    grey = opened(tmp_path).train_ids(np.full((8, 16), 90, np.uint16))
    assert grey.shape == (8, 16)


def test_crop_and_ignore(tmp_path: Path) -> None:
    ids = opened(
        tmp_path, input={"size": [8, 16], "crop": [0.25, 0.5, 0, 0]}, ignore=["car", 1]
    ).train_ids(stripes())
    assert (ids[:2] == UNPAINTED).all()
    assert (ids[4:] == UNPAINTED).all()
    assert ids[2, ::5].tolist() == [ROAD, 255, 255, 255]


def test_a_space_by_name_and_beside_the_spec(tmp_path: Path) -> None:
    ids = opened(tmp_path, {"classes": 19}, classes=None, space="cityscapes").train_ids(stripes())
    assert ids[0, ::5].tolist() == [0, 1, 2, 2]
    (tmp_path / "mine.yaml").write_text(
        "classes: {0: {name: a, to: pole}, 1: {name: b, to: null}, 2: {name: fence}}"
    )
    assert opened(tmp_path, classes=None, space="mine.yaml").train_ids(stripes())[
        0, ::5
    ].tolist() == [5, 255, 4, 4]


@pytest.mark.parametrize(
    ("model", "spec", "match"),
    [
        (
            {},
            {"input": {"size": [8, 8]}},
            "takes an input of 1 x 3 x 8 x 16, but its spec has 1 x 3 x 8 x 8",
        ),
        ({}, {"input": {"size": [8, 16], "layout": "NHWC"}}, r"1 x 8 x 16 x 3 \(NHWC\)"),
        ({}, {"input": {"size": [8, 16], "type": "uint8"}}, r"takes tensor\(float\)"),
        ({}, {"input": {"size": [8, 16], "name": "picture"}}, "no input 'picture': name one of x"),
        ({}, {"output": {"name": "z"}}, "no output 'z': name one of y"),
        ({}, {"classes": ["road", "car"]}, "3 classes in layout CHW, but .* has 2"),
        ({}, {"output": {"layout": "HWC"}}, "16 classes in layout HWC"),
        ({}, {"output": {"kind": "ids"}}, "output.kind may be 'logits'"),
        ({"ids": True}, {}, "output.kind may be 'ids'"),
        (
            {"ids": True},
            {"output": {"kind": "ids"}, "classes": ["road", "car"]},
            "gives the class 2",
        ),
        ({}, {"ignore": ["moose"]}, "ignores 'moose'"),
        ({}, {"sise": 3}, "sise: Extra inputs"),
        ({}, {"input": {"size": [8, 0]}}, "size has to be"),
        ({}, {"input": {"size": [8, 16], "std": [1, 1, 0]}}, "std has to be positive"),
        ({}, {"input": {"size": [8, 16], "crop": [0.5, 0.5, 0, 0]}}, "crop has to be shares"),
        ({}, {"space": "cityscapes"}, "either 'space'"),
        ({}, {"classes": None, "space": "marskitti"}, "marskitti"),
    ],
)
def test_a_model_and_a_spec_that_do_not_fit(
    tmp_path: Path, model: dict[str, Any], spec: dict[str, Any], match: str
) -> None:
    with pytest.raises(SettingsError, match=match):
        opened(tmp_path, model, **spec).train_ids(stripes())


def test_files_that_are_missing_or_no_model(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="needs a model and its spec"):
        Segmenter.open(Labels(source="onnx"))
    opened(tmp_path)
    spec = tmp_path / "spec.yaml"
    with pytest.raises(SettingsError, match="is missing: --seg-model"):
        Segmenter.open(Labels(source="onnx", model=tmp_path / "none.onnx", spec=spec))
    (tmp_path / "model.onnx").write_bytes(b"not a model" * 100)
    with pytest.raises(SettingsError, match="cannot be read as ONNX"):
        Segmenter.open(Labels(source="onnx", model=tmp_path / "model.onnx", spec=spec))


@pytest.mark.parametrize("ids", [False, True])
def test_opencv_where_onnxruntime_is_missing(
    tmp_path: Path, ids: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = opened(
        tmp_path, {"ids": ids}, output={"kind": "ids" if ids else "logits"}
    ).train_ids(stripes())
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    segmenter = opened(tmp_path, {"ids": ids}, output={"kind": "ids" if ids else "logits"})
    assert segmenter.to_json()["runtime"].startswith("opencv")
    np.testing.assert_array_equal(segmenter.train_ids(stripes()), expected)
    (tmp_path / "model.onnx").write_bytes(b"not a model" * 100)
    with pytest.raises(SettingsError, match="cannot be read by OpenCV"):
        Segmenter.open(
            Labels(source="onnx", model=tmp_path / "model.onnx", spec=tmp_path / "spec.yaml")
        )


def test_the_fingerprint_follows_the_files(tmp_path: Path) -> None:
    opened(tmp_path)
    settings = Labels(source="onnx", model=tmp_path / "model.onnx", spec=tmp_path / "spec.yaml")
    before = fingerprint(settings)
    assert before == fingerprint(settings) != ""
    save_model(tmp_path / "model.onnx", classes=4)
    assert fingerprint(settings) != before
    assert fingerprint(Labels()) == ""
    for name in ("mine.yaml", "MINE.YML"):
        space = tmp_path / name
        space.write_text("classes: {0: {name: road}}")
        before = fingerprint(Labels(space=str(space)))
        space.write_text("classes: {0: {name: pole}}")
        assert fingerprint(Labels(space=str(space))) != before
    with pytest.raises(SettingsError, match="cannot be read"):
        fingerprint(settings.model_copy(update={"model": tmp_path / "none.onnx"}))


def save_expanding(path: Path, times: int) -> Path:
    """The sum of ``times`` copies of the input: large on the way, small at the end."""
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 8, 16])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    nodes = [
        helper.make_node("Expand", ["x", "shape"], ["many"]),
        helper.make_node("ReduceMax", ["many"], ["y"], axes=[0], keepdims=1),
    ]
    shape = numpy_helper.from_array(np.array([times, 3, 8, 16], np.int64), "shape")
    model = helper.make_model(
        helper.make_graph(nodes, "expanding", [x], [y], [shape]),
        opset_imports=[helper.make_opsetid("", 13)],
    )
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize(("times", "fits"), [(10_000, True), (100_000, False)])
def test_a_model_that_takes_too_much_memory_is_refused(
    tmp_path: Path, times: int, fits: bool
) -> None:
    """A copy has 1536 bytes: 15 MB and 154 MB, where 64 MiB are allowed."""
    spec = tmp_path / "spec.yaml"
    content = {"input": {"size": [8, 16]}, "classes": ["road", "vegetation", "car"]}
    spec.write_text(yaml.safe_dump(content))
    path = save_expanding(tmp_path / "model.onnx", times)
    settings = Labels(source="onnx", model=path, spec=spec, memory=64 << 20)
    segmenter = Segmenter.open(settings)
    if fits:
        assert segmenter.train_ids(stripes())[0, 0] == ROAD
    else:
        with pytest.raises(SettingsError, match=r"needs more memory than labels\.memory"):
            segmenter.train_ids(stripes())
        # the limit holds for each model that is opened
        larger = settings.model_copy(update={"memory": 1 << 30})
        assert Segmenter.open(larger).train_ids(stripes())[0, 0] == ROAD


def test_an_input_that_takes_too_much_memory_is_refused(tmp_path: Path) -> None:
    spec = tmp_path / "spec.yaml"
    content = {"input": {"size": [4096, 4096]}, "classes": ["road"]}
    spec.write_text(yaml.safe_dump(content))
    path = save_model(tmp_path / "model.onnx")
    with pytest.raises(SettingsError, match="an input that takes 201326592 bytes"):
        Segmenter.open(Labels(source="onnx", model=path, spec=spec, memory=64 << 20))


@pytest.mark.parametrize("runtime", ["onnxruntime", "opencv"])
def test_an_output_that_takes_too_much_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runtime: str
) -> None:
    """700 classes of 128 x 128 pixels are 46 MB, and 184 MB with the copies in which the class is
    found.
    """
    if runtime == "opencv":
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
    spec = tmp_path / "spec.yaml"
    content = {"input": {"size": [128, 128]}, "classes": [f"class {k}" for k in range(700)]}
    spec.write_text(yaml.safe_dump(content))
    path = save_model(tmp_path / "model.onnx", 128, 128, classes=700)
    settings = Labels(source="onnx", model=path, spec=spec, memory=150 << 20)
    with pytest.raises(SettingsError, match=r"an output that takes 183500800 bytes"):
        Segmenter.open(settings).train_ids(stripes())
