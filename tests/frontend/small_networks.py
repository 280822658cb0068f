"""Writes small networks as ONNX files, so that OpenCV runs them as it runs the published weights.

They have the inputs and outputs of ALIKED, DISK and LightGlue, but hold no trained weights: features sit on a fixed
grid and are described by the mean colour around them; a match is what the descriptors say.
"""

import numpy as np

FLOAT, INT64 = 1, 7


def field(number, value):
    """One field of a protocol buffer: an integer, or bytes."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def varint(value):
    value &= (1 << 64) - 1
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def tensor(name, array):
    array = np.asarray(array)
    kind = INT64 if array.dtype == np.int64 else FLOAT
    raw = array.astype(np.int64 if kind == INT64 else np.float32).tobytes()
    dims = b"".join(field(1, size) for size in array.shape)
    return dims + field(2, kind) + field(8, name.encode()) + field(9, raw)


def value(name, kind, shape):
    dims = b"".join(field(1, field(1, size) if isinstance(size, int) else field(2, size.encode())) for size in shape)
    return field(1, name.encode()) + field(2, field(1, field(1, kind) + field(2, dims)))


def attribute(name, given):
    if isinstance(given, int):
        return field(1, name.encode()) + field(3, given) + field(20, 2)
    return field(1, name.encode()) + b"".join(field(8, item) for item in given) + field(20, 7)


def node(kind, inputs, outputs, **attributes):
    content = b"".join(field(1, name.encode()) for name in inputs)
    content += b"".join(field(2, name.encode()) for name in outputs)
    content += field(3, f"make_{outputs[0]}".encode()) + field(4, kind.encode())
    return content + b"".join(field(5, attribute(*pair)) for pair in attributes.items())


def model(nodes, constants, inputs, outputs):
    graph = b"".join(field(1, one) for one in nodes) + field(2, b"small")
    graph += b"".join(field(5, tensor(name, array)) for name, array in constants.items())
    graph += b"".join(field(11, value(*one)) for one in inputs)
    graph += b"".join(field(12, value(*one)) for one in outputs)
    return field(1, 8) + field(8, field(1, b"") + field(2, 13)) + field(7, graph)


def described_grid(side, cells, keypoints, batch=True):
    """A network that puts given keypoints (N, 2), N = cells squared, into ``cells`` x ``cells`` parts of the image.

    A descriptor (3,) is the mean red, green and blue of a part, 0 to 1; a score is the red.
    """
    count, part, lead = cells * cells, side // cells, (1,) if batch else ()
    nodes = [
        node("AveragePool", ["image"], ["parts"], kernel_shape=[part, part], strides=[part, part]),
        node("Reshape", ["parts", "flat_shape"], ["flat"]),
        node("Transpose", ["flat"], ["rows"], perm=[0, 2, 1]),
        node("Reshape", ["rows", "rows_shape"], ["descriptors"]),
        node("Slice", ["descriptors", "first", "second", "last_axis"], ["scores"]),
        node("Identity", ["places"], ["keypoints"]),
    ]
    constants = {
        "flat_shape": np.array([1, 3, count]),
        "rows_shape": np.array([*lead, count, 3]),
        "first": np.array([0]),
        "second": np.array([1]),
        "last_axis": np.array([len(lead) + 1]),
        "places": keypoints.reshape(*lead, count, 2),
    }
    kind = INT64 if keypoints.dtype == np.int64 else FLOAT
    sizes = (("keypoints", kind, 2), ("descriptors", FLOAT, 3), ("scores", FLOAT, 1))
    outputs = [(name, of, (*lead, count, size)) for name, of, size in sizes]
    return model(nodes, constants, [("image", FLOAT, (1, 3, side, side))], outputs)


def nearest_place(count, other):
    """LightGlue's inputs and outputs: pairs each of ``count`` features with one of ``other``, of the largest product.

    The vectors that are multiplied are the normalised keypoint followed by the descriptor (2,).
    """
    nodes = [
        node("Concat", ["kpts0", "desc0"], ["left"], axis=2),
        node("Concat", ["kpts1", "desc1"], ["right"], axis=2),
        node("Transpose", ["right"], ["right_columns"], perm=[0, 2, 1]),
        node("MatMul", ["left", "right_columns"], ["products"]),
        node("ArgMax", ["products"], ["chosen"], axis=2, keepdims=0),
        node("Reshape", ["chosen", "column_shape"], ["chosen_column"]),
        node("Concat", ["numbers", "chosen_column"], ["matches0"], axis=1),
        node("ReduceMax", ["products"], ["largest"], axes=[2], keepdims=0),
        node("Reshape", ["largest", "flat_shape"], ["scaled"]),
        node("Sigmoid", ["scaled"], ["mscores0"]),
    ]
    constants = {
        "column_shape": np.array([count, 1]),
        "numbers": np.arange(count)[:, None],
        "flat_shape": np.array([count]),
    }
    inputs = [
        (f"{what}{side}", FLOAT, (1, size, 2)) for side, size in ((0, count), (1, other)) for what in ("kpts", "desc")
    ]
    return model(nodes, constants, inputs, [("matches0", INT64, (count, 2)), ("mscores0", FLOAT, (count,))])
