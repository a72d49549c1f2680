"""I3D equals the reference's architecture in torch, on random weights and norms, and odd sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from safetensors.numpy import save_file
from torch.nn import functional

from pewm_jax.config import UserError
from pewm_jax.io import tree, weights
from pewm_jax.models.i3d import convert as i3d_weights
from pewm_jax.models.i3d import model as i3d
from pewm_jax.train import flops
from tests import properties

nn = torch.nn


def same(x, kernel, stride):
    """Pad as TensorFlow does, the odd zero at the end (pytorch-i3d's ``compute_pad``)."""
    pads = []
    for size, k, step in zip(
        reversed(x.shape[2:]), reversed(kernel), reversed(stride), strict=True
    ):
        missing = max(k - step, 0) if size % step == 0 else max(k - size % step, 0)
        pads += [missing // 2, missing - missing // 2]
    return functional.pad(x, pads)


class Unit(nn.Module):
    """``Unit3D``: convolution, batch norm, ReLU."""

    def __init__(self, inward, out, side=1, stride=1, head=False):
        super().__init__()
        self.side, self.stride = (side,) * 3, (stride,) * 3
        self.conv3d = nn.Conv3d(inward, out, side, stride, bias=head)
        self.head = head
        if not head:
            self.bn = nn.BatchNorm3d(out, eps=0.001, momentum=0.01)

    def forward(self, x):
        x = self.conv3d(same(x, self.side, self.stride))
        return x if self.head else functional.relu(self.bn(x))


class Pool(nn.Module):
    """``MaxPool3dSamePadding``."""

    def __init__(self, kernel, stride):
        super().__init__()
        self.kernel, self.stride = kernel, stride

    def forward(self, x):
        return functional.max_pool3d(same(x, self.kernel, self.stride), self.kernel, self.stride)


class Inception(nn.Module):
    """``InceptionModule``."""

    def __init__(self, inward, out):
        super().__init__()
        self.b0 = Unit(inward, out[0])
        self.b1a, self.b1b = Unit(inward, out[1]), Unit(out[1], out[2], 3)
        self.b2a, self.b2b = Unit(inward, out[3]), Unit(out[3], out[4], 3)
        self.pool, self.b3b = Pool((3, 3, 3), (1, 1, 1)), Unit(inward, out[5])

    def forward(self, x):
        branches = self.b0(x), self.b1b(self.b1a(x)), self.b2b(self.b2a(x)), self.b3b(self.pool(x))
        return torch.cat(branches, 1)


class Reference(nn.Module):
    """``InceptionI3d`` with the names of its state (pytorch_i3d.py)."""

    def __init__(self):
        super().__init__()
        self.order = []
        for name, layer in (
            ("Conv3d_1a_7x7", Unit(3, 64, 7, 2)),
            ("MaxPool3d_2a_3x3", Pool((1, 3, 3), (1, 2, 2))),
            ("Conv3d_2b_1x1", Unit(64, 64)),
            ("Conv3d_2c_3x3", Unit(64, 192, 3)),
            ("MaxPool3d_3a_3x3", Pool((1, 3, 3), (1, 2, 2))),
            ("Mixed_3b", Inception(192, (64, 96, 128, 16, 32, 32))),
            ("Mixed_3c", Inception(256, (128, 128, 192, 32, 96, 64))),
            ("MaxPool3d_4a_3x3", Pool((3, 3, 3), (2, 2, 2))),
            ("Mixed_4b", Inception(480, (192, 96, 208, 16, 48, 64))),
            ("Mixed_4c", Inception(512, (160, 112, 224, 24, 64, 64))),
            ("Mixed_4d", Inception(512, (128, 128, 256, 24, 64, 64))),
            ("Mixed_4e", Inception(512, (112, 144, 288, 32, 64, 64))),
            ("Mixed_4f", Inception(528, (256, 160, 320, 32, 128, 128))),
            ("MaxPool3d_5a_2x2", Pool((2, 2, 2), (2, 2, 2))),
            ("Mixed_5b", Inception(832, (256, 160, 320, 32, 128, 128))),
            ("Mixed_5c", Inception(832, (384, 192, 384, 48, 128, 128))),
        ):
            self.add_module(name, layer)
            self.order.append(name)
        self.logits = Unit(1024, 400, head=True)
        self.eval()

    def trunk(self, x):
        for name in self.order:
            x = getattr(self, name)(x)
        return x

    def forward(self, x):
        x = self.logits(functional.avg_pool3d(self.trunk(x), (2, 7, 7), stride=1))
        return x.squeeze(3).squeeze(3).mean(2)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A network of torch with random weights and norms, and its state in a file."""
    torch.manual_seed(0)
    reference = Reference()
    with torch.no_grad():
        for layer in reference.modules():
            if isinstance(layer, nn.BatchNorm3d):
                layer.running_mean.normal_(0, 0.1)
                layer.running_var.uniform_(0.05, 0.3)
                layer.weight.uniform_(0.5, 1.5)
                layer.bias.normal_(0, 0.1)
    path = tmp_path_factory.mktemp("weights") / "i3d_pretrained_400.pt"
    torch.save(reference.state_dict(), path)
    return reference, path


def theirs(function, x_BTHWC):
    with torch.no_grad():
        return function(torch.tensor(np.moveaxis(x_BTHWC, -1, 1))).numpy()


def videos(*shape):
    return np.random.default_rng(sum(shape)).uniform(-1, 1, (*shape, 3)).astype(np.float32)


def near(got, want):
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-4 * np.abs(want).max())


@pytest.mark.parametrize("shape", properties.first([(2, 9, 64, 33), (1, 12, 31, 70)], 1))
def test_the_last_modules_output_equals_torchs(pair, shape):
    reference, path = pair
    params, x = i3d_weights.read(path), videos(*shape)
    want = np.moveaxis(theirs(reference.trunk, x), 1, -1)
    assert want.std() > 0.01
    near(jax.jit(i3d.trunk)(params, x), want)


@pytest.mark.slow
def test_logits_equal_torchs(pair):
    reference, path = pair
    x = videos(1, 9, 224, 224)
    near(jax.jit(i3d.apply)(i3d_weights.read(path), x), theirs(reference, x))


def test_pictures_are_resized_as_torch_does_with_antialiasing():
    for size in ((64, 48), (250, 300)):  # larger, smaller
        x = videos(1, 9, *size)
        pictures = torch.tensor(np.moveaxis(x[0], -1, 1))
        made = functional.interpolate(
            pictures, (224, 224), mode="bilinear", align_corners=False, antialias=True
        ).numpy()
        want = np.moveaxis(made, 1, -1)[None]
        np.testing.assert_allclose(i3d.resize(x), want, atol=1e-4)


def test_a_file_of_ours_and_a_safetensors_of_torchs_are_the_same_weights(pair, tmp_path):
    reference, path = pair
    params = i3d_weights.read(path)
    weights.save(tmp_path / "ours.safetensors", params)
    state = {name: x.numpy() for name, x in reference.state_dict().items()}
    save_file(state, tmp_path / "torch.safetensors")
    for name in ("ours", "torch"):
        again = i3d_weights.read(tmp_path / f"{name}.safetensors")
        jax.tree.map(np.testing.assert_array_equal, again, params)
    del state["Mixed_4b.b1a.bn.running_var"]
    save_file(state, tmp_path / "less.safetensors")
    with pytest.raises(UserError, match="lacks Mixed_4b/b1a/var"):
        i3d_weights.read(tmp_path / "less.safetensors")
    state["Mixed_4b.b1a.bn.running_var"] = np.ones(3, np.float32)
    save_file(state, tmp_path / "wrong.safetensors")
    with pytest.raises(UserError, match="a batch norm at Mixed_4b/b1a that does not fit"):
        i3d_weights.read(tmp_path / "wrong.safetensors")
    state["Mixed_4b.b1a.bn.running_var"] = np.ones(96, np.float32)
    save_file({**state, "more.weight": np.ones(3)}, tmp_path / "more.safetensors")
    with pytest.raises(UserError, match=r"more\.weight"):
        i3d_weights.read(tmp_path / "more.safetensors")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_torchscript_file_is_refused(tmp_path):
    torch.jit.trace(nn.ReLU(), torch.zeros(1)).save(tmp_path / "i3d_torchscript.pt")
    with pytest.raises(UserError, match=r"i3d_torchscript.pt cannot be read as a table of tensors"):
        i3d_weights.read(tmp_path / "i3d_torchscript.pt")
    with pytest.raises(
        UserError, match="gone does not exist; give the path of a file with the weights of I3D"
    ):
        i3d_weights.read(tmp_path / "gone")


@pytest.mark.slow
def test_the_packages_weights_give_torchs_logits_and_the_published_distance():
    params, reference = i3d_weights.read(i3d_weights.find()), Reference()
    flat = tree.flatten(params)
    with torch.no_grad():
        for name, unit in reference.named_modules():
            if isinstance(unit, Unit):
                ours = name.replace(".", "/")
                unit.conv3d.weight.copy_(
                    torch.tensor(flat[f"{ours}/kernel"].transpose(4, 3, 0, 1, 2))
                )
                bias = unit.conv3d.bias if unit.head else unit.bn.bias
                bias.copy_(torch.tensor(flat[f"{ours}/bias"]))
                if not unit.head:
                    unit.bn.running_var.fill_(1 - unit.bn.eps)
    apply = jax.jit(i3d.apply)
    x = videos(1, 9, 224, 224)
    near(apply(params, x), theirs(reference, x))
    black, white = (apply(params, np.full((1, 15, 64, 64, 3), x, np.float32)) for x in (-1, 1))
    distance = float(np.square(black - white).sum())  # black videos against white ones
    assert distance == pytest.approx(131, rel=0.03)  # frechet_video_distance/example.py: "around"


def test_parameters_have_the_shapes_of_the_table_and_costs_are_those_published():
    params = jax.eval_shape(i3d.init, jax.random.key(0))
    assert {path: x.shape for path, x in tree.flatten(params).items()} == i3d.shapes()
    count = sum(int(np.prod(shape)) for shape in i3d.shapes().values())
    assert count == pytest.approx(12.7e6, rel=0.01)
    video = jax.ShapeDtypeStruct((1, 64, 224, 224, 3), jnp.float32)
    counted = flops.executed(jax.make_jaxpr(i3d.apply)(params, video)).total
    assert counted / 2 == pytest.approx(108e9, rel=0.05)


def test_videos_that_cannot_be_taken_are_refused():
    params = jax.tree.map(lambda x: np.zeros(x.shape), jax.eval_shape(i3d.init, jax.random.key(0)))
    with pytest.raises(UserError, match=r"clips of 8 frames are too short for I3D.*at least 9"):
        i3d.apply(params, np.zeros((1, 8, 64, 64, 3), np.float32))
    with pytest.raises(UserError, match=r"I3D cannot take a video of shape \(9, 64, 64, 3\)"):
        i3d.apply(params, np.zeros((9, 64, 64, 3), np.float32))
