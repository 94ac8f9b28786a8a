"""ONNX Runtime's side: inference of the base-16 network, batch norms folded, as an exporter leaves it."""

import argparse

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

import network
from protocol import serve


class Graph:
    """Collects nodes and weights."""

    def __init__(self):
        self.nodes, self.weights, self.random = [], [], np.random.default_rng(1)

    def add(self, op, inputs, **attributes):
        output = f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, inputs, [output], **attributes))
        return output

    def constant(self, name, values):
        self.weights.append(numpy_helper.from_array(values.astype(np.float32), name))
        return name

    def layer(self, name, x):
        kind, inputs, outputs = KINDS[name]
        size = {"up": 4, "1x1": 1}.get(kind, 3)
        shape = (inputs, outputs, size, size) if kind == "up" else (outputs, inputs, size, size)
        spread = (2 / (inputs * size * size)) ** 0.5
        weight = self.constant(f"{name}.weight", self.random.normal(0, spread, shape))
        bias = self.constant(f"{name}.bias", np.full(outputs, 0.01))
        if kind == "up":
            x = self.add("ConvTranspose", [x, weight, bias], strides=[2, 2], pads=[1, 1, 1, 1])
        else:
            pad = size // 2
            x = self.add("Conv", [x, weight, bias], kernel_shape=[size, size], pads=[pad] * 4)
        return self.add("Relu", [x])

    def encode(self, name, x):
        skips = []
        for level in range(len(network.WIDTHS)):
            for unit in range(3):
                x = self.layer(f"{name}.{level}.{unit}", x)
            skips.append(x)
            x = self.add("MaxPool", [x], kernel_shape=[2, 2], strides=[2, 2])
        return skips, x


KINDS = {name: (kind, inputs, outputs) for name, kind, inputs, outputs in network.layers()}


def build(height, width):
    graph = Graph()
    x = "features"
    for i in range(4):
        x = graph.layer(f"fusion.{i}", x)
    of_features, _ = graph.encode("feature", x)
    of_colour, x = graph.encode("colour", "colour")
    for level in reversed(range(len(network.WIDTHS))):
        up = graph.layer(f"up.{level}", x)
        x = graph.add("Concat", [up, of_features[level], of_colour[level]], axis=1)
        x = graph.layer(f"fuse.{level}", x)
    x = graph.add("Pow", [graph.layer("output", x), graph.constant("gamma", np.array(network.GAMMA))])
    info = helper.make_tensor_value_info
    inputs = [
        info(name, TensorProto.FLOAT, (1, channels, height, width))
        for name, channels in (("colour", network.COLOUR), ("features", network.FEATURES))
    ]
    output = info(x, TensorProto.FLOAT, (1, 3, height, width))
    model = helper.make_model(
        helper.make_graph(graph.nodes, "demc", inputs, [output], graph.weights),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=8,
    )
    onnx.checker.check_model(model)
    return model


def infer(height, width, threads):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Between its turns it must not keep the cores busy.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    model = build(height, width).SerializeToString()
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    random = np.random.default_rng(2)
    feeds = {i.name: random.random(i.shape, dtype=np.float32) for i in session.get_inputs()}

    def run():
        (image,) = session.run(None, feeds)
        assert np.isfinite(image[0, :, ::97, ::89]).all()

    return run


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--small", action="store_true")
    args = parser.parse_args()
    size = (96, 160) if args.small else (736, 1280)
    jobs = {"infer base16 f32": lambda: infer(*size, args.threads)}
    facts = {"program": f"onnxruntime {onnxruntime.__version__}", "parameters": network.parameters()}
    serve(jobs, facts)


if __name__ == "__main__":
    main()
