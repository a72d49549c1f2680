"""LPIPS equals the reference's architecture in torch, on random weights and odd sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from pewm_jax.config import UserError
from pewm_jax.io import tree, weights
from pewm_jax.models.lpips import convert as lpips_weights
from pewm_jax.models.lpips import model as lpips
from pewm_jax.train import flops

CUTS = {"alex": (2, 5, 8, 10, 12), "vgg": (4, 9, 16, 23, 30)}
"""Where torchvision's ``features`` are cut into slices (lpips/pretrained_networks.py)."""
SIZES = {"alex": ((31, 31), (64, 64), (47, 70)), "vgg": ((16, 16), (33, 21))}
"""The smallest, the demo's, and odd ones."""


def torch_layers(net):
    """torchvision's ``alexnet().features`` and ``vgg16().features``, as far as they are used."""
    nn, relu = torch.nn, lambda: torch.nn.ReLU(inplace=True)
    if net == "alex":
        return [
            *(nn.Conv2d(3, 64, 11, stride=4, padding=2), relu(), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(64, 192, 5, padding=2), relu(), nn.MaxPool2d(3, 2)),
            *(nn.Conv2d(192, 384, 3, padding=1), relu()),
            *(nn.Conv2d(384, 256, 3, padding=1), relu()),
            *(nn.Conv2d(256, 256, 3, padding=1), relu()),
        ]
    layers, inward = [], 3
    for out in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if out:
            layers += [nn.Conv2d(inward, out, 3, padding=1), relu()]
            inward = out
        else:
            layers.append(nn.MaxPool2d(2, 2))
    return layers


class Reference(torch.nn.Module):
    """``lpips.LPIPS(net)`` with the names of its state (lpips/lpips.py, version 0.1)."""

    def __init__(self, net):
        super().__init__()
        layers, first = torch_layers(net), 0
        self.net = torch.nn.Module()
        for k, last in enumerate(CUTS[net]):
            slice_k = torch.nn.Sequential()
            for i in range(first, last):
                slice_k.add_module(str(i), layers[i])
            setattr(self.net, f"slice{k + 1}", slice_k)
            first = last
        widths = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}[net]
        for k, width in enumerate(widths):
            lin = torch.nn.Module()
            lin.model = torch.nn.Sequential(
                torch.nn.Dropout(), torch.nn.Conv2d(width, 1, 1, bias=False)
            )
            setattr(self, f"lin{k}", lin)
        self.lins = torch.nn.ModuleList([getattr(self, f"lin{k}") for k in range(5)])
        self.scaling_layer = torch.nn.Module()
        shift, scale = [-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]
        self.scaling_layer.register_buffer("shift", torch.tensor(shift)[None, :, None, None])
        self.scaling_layer.register_buffer("scale", torch.tensor(scale)[None, :, None, None])
        self.eval()

    def forward(self, a, b):
        total = 0
        a, b = ((x - self.scaling_layer.shift) / self.scaling_layer.scale for x in (a, b))
        for k in range(5):
            a, b = (getattr(self.net, f"slice{k + 1}")(x) for x in (a, b))
            one, other = (
                x / (torch.sqrt(torch.sum(x**2, dim=1, keepdim=True)) + 1e-10) for x in (a, b)
            )
            total = total + self.lins[k].model((one - other) ** 2).mean([2, 3])
        return total[:, 0]


@pytest.fixture(scope="module", params=["alex", "vgg"])
def pair(request, tmp_path_factory):
    """A network of torch with random weights, and its state in a file."""
    torch.manual_seed(0)
    reference = Reference(request.param)
    with torch.no_grad():
        for lin in reference.lins:
            lin.model[1].weight.abs_()
    path = tmp_path_factory.mktemp("weights") / f"{request.param}.pth"
    torch.save(reference.state_dict(), path)
    return request.param, reference, path


def pictures(height, width, count=3):
    rng = np.random.default_rng(height)
    a = rng.uniform(-1, 1, (count, height, width, 3)).astype(np.float32)
    b = np.clip(a + 0.3 * rng.standard_normal(a.shape), -1, 1).astype(np.float32)
    return a, b


def theirs(reference, a, b):
    with torch.no_grad():
        return reference(*(torch.tensor(x.transpose(0, 3, 1, 2)) for x in (a, b))).numpy()


@pytest.mark.slow
def test_distances_equal_torchs(pair):
    net, reference, path = pair
    found, params = lpips_weights.read(path)
    assert found == net
    for size in SIZES[net]:
        a, b = pictures(*size)
        want, got = theirs(reference, a, b), lpips.apply(net, params, a, b)
        assert want.min() > 0.01
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-6)


def test_a_file_of_ours_and_a_safetensors_of_torchs_are_the_same_weights(pair, tmp_path):
    net, reference, path = pair
    _, params = lpips_weights.read(path)
    weights.save(tmp_path / "ours.safetensors", params)
    state = {name: x.numpy() for name, x in reference.state_dict().items()}
    save_file(state, tmp_path / "torch.safetensors")
    for name in ("ours", "torch"):
        found, again = lpips_weights.read(tmp_path / f"{name}.safetensors", net)
        assert found == net
        jax.tree.map(np.testing.assert_array_equal, again, params)
    other = {"alex": "vgg", "vgg": "alex"}[net]
    with pytest.raises(UserError, match=r"holds the weights of \w+, not of \w+"):
        lpips_weights.read(path, other)


@pytest.mark.slow(but="alex")
@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_the_packages_weights_give_torchs_distances(net):
    _, params = lpips_weights.read(lpips_weights.find(net), net)
    reference, number = Reference(net), 0
    with torch.no_grad():
        for layer in reference.net.modules():
            if isinstance(layer, torch.nn.Conv2d):
                part = params["net"][f"conv_{number}"]
                layer.weight.copy_(torch.tensor(part["kernel"].transpose(3, 2, 0, 1)))
                layer.bias.copy_(torch.tensor(part["bias"]))
                number += 1
        for k, lin in enumerate(reference.lins):
            lin.model[1].weight.copy_(
                torch.tensor(params["lin"][f"layer_{k}"])[None, :, None, None]
            )
    a, b = pictures(64, 64)
    np.testing.assert_allclose(
        lpips.apply(net, params, a, b), theirs(reference, a, b), rtol=1e-4, atol=1e-5
    )


@pytest.mark.slow
def test_the_gradient_is_finite_and_torchs_where_torch_has_one():
    params = jax.jit(lpips.init, static_argnums=0)("alex", jax.random.key(0))
    a, b = (jnp.asarray(x) for x in pictures(40, 33, 2))
    slope = jax.jit(jax.grad(lambda x: lpips.apply("alex", params, x, b).sum()))
    assert np.isfinite(slope(a)).all()
    assert np.abs(slope(a)).max() > 0
    np.testing.assert_array_equal(slope(b), 0)
    silent = jax.tree.map(jnp.zeros_like, params)  # every feature is 0: torch's gradient is NaN
    dead = jax.grad(lambda x: lpips.apply("alex", silent, x, b).sum())(a)
    np.testing.assert_array_equal(dead, 0)


def test_parameters_have_the_shapes_of_the_table_and_costs_are_those_of_torch():
    for net in ("alex", "vgg"):
        params = jax.eval_shape(lambda key, net=net: lpips.init(net, key), jax.random.key(0))
        have = {path: x.shape for path, x in tree.flatten(params).items()}
        assert have == lpips.shapes(net)
    picture = jax.ShapeDtypeStruct((1, 224, 224, 3), jnp.float32)
    # torchvision's 0.71 and 15.5 G multiply-adds, less the classifiers; of two pictures.
    for net, published in (("alex", 0.656e9), ("vgg", 15.35e9)):
        params = jax.eval_shape(lambda key, net=net: lpips.init(net, key), jax.random.key(0))
        jaxpr = jax.make_jaxpr(lpips.apply, static_argnums=0)(net, params, picture, picture)
        assert flops.executed(jaxpr).total / 4 == pytest.approx(published, rel=0.01)


def test_pictures_that_cannot_be_compared_are_refused():
    params = jax.jit(lpips.init, static_argnums=0)("alex", jax.random.key(0))
    a = np.zeros((1, 30, 64, 3), np.float32)
    with pytest.raises(UserError, match=r"30×64 pixels are too small .* use VGG16"):
        lpips.apply("alex", params, a, a)
    with pytest.raises(UserError, match="cannot be compared"):
        lpips.apply("alex", params, a, a[:, :, 1:])
    with pytest.raises(UserError, match=r"at least 16×16$"):
        lpips.require_size("vgg", 15, 40)
