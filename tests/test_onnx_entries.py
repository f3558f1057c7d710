"""The networks of other programs: what an ONNX file that enters the benchmark gets, and which ones are refused."""

import json

import cv2
import numpy as np
import pytest

from cloning.base.errors import UserError
from simulator import driving


def onnx_file(path, shape, axes, kind, reduced="ReduceMean", more=()):
    """A network that steers by the mean over these axes of its input; more: names of inputs that it leaves unused."""
    from onnx import TensorProto, helper, save

    nodes = [
        helper.make_node("Cast", ["frames"], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node(reduced, ["numbers"], ["steering"], axes=axes, keepdims=0),
    ]
    taken = [helper.make_tensor_value_info("frames", kind, shape)]
    taken += [helper.make_tensor_value_info(name, TensorProto.FLOAT, (1, 1)) for name in more]
    given = helper.make_tensor_value_info("steering", TensorProto.FLOAT, None)
    graph = helper.make_graph(nodes, "mean", taken, [given])
    save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)
    return str(path)


@pytest.mark.parametrize(("shape", "axes"), [((1, 66, 200, 3), [1, 2]), ((None, 3, 66, 200), [2, 3])])
def test_an_onnx_network_gets_frames_as_the_file_beside_it_says(tmp_path, shape, axes):
    """By the definition of YUV: Y of pure red is 0.299 of white's."""
    file = onnx_file(tmp_path / "keras.onnx", shape, axes, kind=1)
    about = {"crop": [60, 25, 20, 20], "colour": "YUV", "range": [-1, 1]}
    (tmp_path / "keras.json").write_text(json.dumps(about), encoding="utf-8")
    frame = np.full((160, 320, 3), 255, np.uint8)  # white where it is cut off
    frame[60:135, 20:300] = (255, 0, 0)
    assert driving.load_driver(file)(frame) == pytest.approx(2 * 0.299 - 1, abs=0.005)
    digest = driving.digest_of(tmp_path / "keras.onnx")
    crops = (f'{{"crop": {crop}}}' for crop in ([100, 60], [0, 0, 320, 0], [1, 2, 3], [1.5, 0]))
    ranges = (f'{{"range": {ends}}}' for ends in ([0], [0, [1, 2]], ["0", "1"]))
    for wrong in (*crops, *ranges, '{"blur": 2}', '{"blur": -1}', '{"colour": "CMYK"}', '{"scale": 2}', "[]", "{"):
        (tmp_path / "keras.json").write_text(wrong, encoding="utf-8")
        with pytest.raises(UserError, match=r"keras\.json: does not tell"):
            driving.load_driver(file)
        assert driving.digest_of(tmp_path / "keras.onnx") != digest, "earlier results are another entry's"


def test_a_network_whose_weights_are_beside_it_is_another_entry_with_others(tmp_path):
    """Current PyTorch exports them so."""
    import onnx

    path, weights = tmp_path / "own.onnx", tmp_path / "weights" / f"{130 * 'w'}.data"
    weights.parent.mkdir()
    steers, digests = [], set()
    for constant in (0.25, -0.5):
        model = onnx.load(onnx_file(path, (1, 160, 320, 3), [1, 2, 3], kind=1))
        model.graph.initializer.append(onnx.numpy_helper.from_array(np.full(1, constant, np.float32), "weight"))
        model.graph.node.append(onnx.helper.make_node("Add", ["steering", "weight"], ["angle"]))
        model.graph.output[0].name = "angle"
        weights.unlink(missing_ok=True)  # else ONNX would append to it
        onnx.save(model, path, save_as_external_data=True, location=f"weights/{weights.name}", size_threshold=0)
        digests.add(driving.digest_of(path))
        steers.append(driving.load_driver(str(path))(np.zeros((160, 320, 3), np.uint8)))
    assert steers == [0.25, -0.5] and len(digests) == 2


def test_without_that_file_frames_are_as_the_simulator_sends_them(tmp_path):
    file = onnx_file(tmp_path / "own.onnx", (None, 160, 320, 3), [1, 2], kind=2)
    assert driving.load_driver(file)(np.full((160, 320, 3), (0, 200, 200), np.uint8)) == 0
    bright = onnx_file(tmp_path / "bright.onnx", (1, 160, 320, 3), [1, 2], 2, reduced="ReduceLogSum")
    assert driving.load_driver(bright)(np.full((160, 320, 3), 200, np.uint8)) == 1  # but no number for a black frame
    (tmp_path / "own.json").write_text('{"range": [-1, 1]}', encoding="utf-8")
    with pytest.raises(UserError, match="does not tell"):  # bytes can't be so
        driving.preprocessing(tmp_path / "own.json", [1, 160, 320, 3], whole=True)
    prepare = driving.preprocessing(tmp_path / "none.json", [1, 160, 320, 3], whole=True)
    frame = np.random.default_rng(0).integers(0, 256, (160, 320, 3), np.uint8)
    assert np.array_equal(prepare(frame)[0], frame)


@pytest.mark.parametrize(("shape", "axes"), [((1, 66, 200, 1), [1, 2]), ((None, 1, 66, 200), [2, 3])])
def test_an_onnx_network_may_see_gray_images(tmp_path, shape, axes):
    """Gray is Y of YUV."""
    file = onnx_file(tmp_path / "gray.onnx", shape, axes, kind=1)
    (tmp_path / "gray.json").write_text('{"colour": "GRAY", "range": [0, 1]}', encoding="utf-8")
    red = np.full((160, 320, 3), (255, 0, 0), np.uint8)
    assert driving.load_driver(file)(red) == pytest.approx(0.299, abs=0.005)


def test_a_network_gets_the_blurred_frames_that_it_was_trained_on(tmp_path):
    """As most public drive.py of Udacity's simulator do it: cut, YUV, blurred, scaled, divided by 255."""
    frame = np.random.default_rng(0).integers(60, 200, (160, 320, 3), np.uint8)
    theirs = cv2.GaussianBlur(cv2.cvtColor(frame[60:135], cv2.COLOR_RGB2YUV), (3, 3), 0)
    theirs = cv2.resize(theirs, (200, 66)) / 255
    farthest = []
    for blur in (3, 1):
        about = {"crop": [60, 25], "blur": blur, "colour": "YUV", "range": [0, 1]}
        (tmp_path / "own.json").write_text(json.dumps(about), encoding="utf-8")
        prepare = driving.preprocessing(tmp_path / "own.json", [1, 66, 200, 3], whole=False)
        farthest.append(np.abs(prepare(frame)[0] - theirs).max() * 255)
    assert farthest[0] < 3 and farthest[1] > 20, "rounded, and without it"


@pytest.mark.parametrize("shape", [(1, 8, 9, 3), (1, 3, 8, 9)])
def test_each_colour_may_have_a_range_of_its_own(tmp_path, shape):
    """As of torchvision's Normalize, with the means and deviations of ImageNet."""
    mean, deviation = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    ends = [list((each - mean) / deviation) for each in (0, 1)]
    (tmp_path / "own.json").write_text(json.dumps({"range": ends}), encoding="utf-8")
    prepare = driving.preprocessing(tmp_path / "own.json", list(shape), whole=False)
    prepared = prepare(np.full((160, 320, 3), (51, 102, 153), np.uint8))
    expected = (np.array([0.2, 0.4, 0.6]) - mean) / deviation
    assert prepared.shape == shape and prepared.dtype == np.float32
    np.testing.assert_allclose(np.moveaxis(prepared, shape.index(3), -1), np.tile(expected, (1, 8, 9, 1)), rtol=1e-6)


@pytest.mark.parametrize(
    ("names", "steers"),
    [
        (("speed", "steering"), 1),  # as tf2onnx sorts those of a saved model
        (("throttle", "brake", "Steer:0"), 2),
        (("angle_out", "throttle_out"), 0),  # donkeycar's
        (("n_outputs0", "n_outputs1"), 0),
    ],
)
def test_of_several_outputs_the_steering_is_known_by_its_name(tmp_path, names, steers):
    import onnx

    model = onnx.load(onnx_file(tmp_path / "own.onnx", (1, 160, 320, 3), [1, 2, 3], kind=1))
    del model.graph.node[:], model.graph.output[:]
    for n, name in enumerate(names):
        constant = onnx.helper.make_tensor("value", onnx.TensorProto.FLOAT, (1, 1), [n / 4])
        model.graph.node.append(onnx.helper.make_node("Constant", [], [name], value=constant))
        model.graph.output.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, (1, 1)))
    onnx.save(model, tmp_path / "own.onnx")
    assert driving.load_driver(str(tmp_path / "own.onnx"))(np.zeros((160, 320, 3), np.uint8)) == steers / 4


@pytest.mark.parametrize(
    ("shape", "axes", "kind", "more", "reason"),
    [
        ((1, 160, 320, 3), [1, 2], 11, (), "expected: (tensor(double))"),
        ((2, 160, 320, 3), [1, 2], 1, (), "Got: 1 Expected: 2"),
        ((), None, 1, (), "its input is []"),
        ((1, 5, 66, 200, 3), [1, 2, 3], 1, (), "its input is [1, 5, 66, 200, 3]"),
        ((1, 66, 200, 1), [1, 2], 1, (), "not (1, rows, columns, 3) or (1, 3, rows, columns), as for RGB"),
        ((1, 66, 200, 3), [1, 2], 1, ("speed",), "its inputs are frames, speed"),
        ((1, 15, 200, 3), [2, 3], 1, (), "its output steering has 15 numbers"),
    ],
)
def test_an_onnx_network_of_another_kind_is_refused_before_it_drives(tmp_path, shape, axes, kind, more, reason):
    file = onnx_file(tmp_path / "other.onnx", shape, axes, kind, more=more)
    with pytest.raises(UserError, match=r"other\.onnx: does not steer by a frame as LEADERBOARD\.md says") as caught:
        driving.load_driver(file)
    assert reason in str(caught.value) and "\n" not in str(caught.value)


def test_what_is_wrong_with_an_onnx_entry_is_told_shortly_and_to_the_end(tmp_path):
    import onnx

    file = onnx_file(tmp_path / "model.onnx", (1, 66, 200, 3), [1, 2], kind=1)
    about = {"class_name": "Sequential", "config": {"layers": ["Conv2D"] * 100}}  # Keras' file about a network
    (tmp_path / "model.json").write_text(json.dumps(about), encoding="utf-8")
    with pytest.raises(UserError, match="it has class_name, config") as caught:
        driving.load_driver(file)
    assert "Conv2D" not in str(caught.value)
    (tmp_path / "model.json").write_text('{"crop": [100, 60]}', encoding="utf-8")
    with pytest.raises(UserError, match="a frame has 160 rows and 320 columns"):
        driving.load_driver(file)
    (tmp_path / "model.json").unlink()
    model = onnx.load(file)
    model.ir_version = 99
    onnx.save(model, file)
    with pytest.raises(UserError, match="Unsupported model IR version: 99, max supported IR version"):
        driving.load_driver(file)
