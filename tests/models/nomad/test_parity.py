"""NoMaD equals torch modules with the published names, on random weights, norms and odd sizes."""

import dataclasses
import functools
import itertools
import math

import jax
import numpy as np
import pytest
import torch
from torch.nn import functional

from pewm_jax.config import UserError
from pewm_jax.diffusion import squared_cosine
from pewm_jax.models.nomad import convert as converter
from pewm_jax.models.nomad import efficientnet
from pewm_jax.models.nomad import model as nomad
from pewm_jax.models.nomad.config import NomadConfig

nn = torch.nn
SMALL = NomadConfig(
    height=20,
    width=27,
    context=2,
    trunk_width=0.5,
    trunk_depth=0.5,
    trunk_stages=3,
    dim=32,
    layers=2,
    heads=2,
    waypoints=8,
    channels=(16, 24, 32),
    time_dim=16,
    groups=4,
)


def norm(channels):
    return nn.GroupNorm(efficientnet.groups(channels), channels)


class Conv(nn.Conv2d):
    """``Conv2dStaticSamePadding`` of efficientnet_pytorch, made for even sizes."""

    def forward(self, x):
        missing = self.kernel_size[0] - self.stride[0]
        x = functional.pad(x, 2 * (missing // 2, missing - missing // 2)) if missing > 0 else x
        return super().forward(x)


class Bottleneck(nn.Module):
    """``MBConvBlock``."""

    def __init__(self, block):
        super().__init__()
        hidden, plain = block.hidden, {"bias": False}
        if hidden != block.inward:
            self._expand_conv = Conv(block.inward, hidden, 1, **plain)
            self._bn0 = norm(hidden)
        self._depthwise_conv = Conv(
            hidden, hidden, block.kernel, block.stride, groups=hidden, **plain
        )
        self._bn1 = norm(hidden)
        squeezed = max(1, int(block.inward * 0.25))
        self._se_reduce, self._se_expand = Conv(hidden, squeezed, 1), Conv(squeezed, hidden, 1)
        self._project_conv = Conv(hidden, block.outward, 1, **plain)
        self._bn2 = norm(block.outward)
        self.skip = block.stride == 1 and block.inward == block.outward

    def forward(self, inputs):
        x = inputs
        if hasattr(self, "_expand_conv"):
            x = functional.silu(self._bn0(self._expand_conv(x)))
        x = functional.silu(self._bn1(self._depthwise_conv(x)))
        squeezed = functional.silu(self._se_reduce(functional.adaptive_avg_pool2d(x, 1)))
        x = self._bn2(self._project_conv(torch.sigmoid(self._se_expand(squeezed)) * x))
        return x + inputs if self.skip else x


class EfficientNet(nn.Module):
    """``EfficientNet`` without the classifier's use."""

    def __init__(self, config, colours):
        super().__init__()
        width = config.trunk_width
        blocks = efficientnet.blocks(width, config.trunk_depth, config.trunk_stages)
        self._conv_stem = Conv(colours, efficientnet.scaled(32, width), 3, 2, bias=False)
        self._bn0 = norm(efficientnet.scaled(32, width))
        self._blocks = nn.ModuleList(Bottleneck(block) for block in blocks)
        out = efficientnet.features(width)
        self._conv_head = Conv(blocks[-1].outward, out, 1, bias=False)
        self._bn1 = norm(out)
        self._fc = nn.Linear(out, 5)

    def forward(self, x):
        x = functional.silu(self._bn0(self._conv_stem(x)))
        for block in self._blocks:
            x = block(x)
        return functional.silu(self._bn1(self._conv_head(x))).mean((2, 3))


class Positions(nn.Module):
    """``PositionalEncoding``."""

    def __init__(self, dim, count):
        super().__init__()
        table = torch.zeros(count, dim)
        at = torch.arange(count).float()[:, None]
        rate = torch.exp(torch.arange(0, dim, 2).float() * (-math.log(10000.0) / dim))
        table[:, 0::2], table[:, 1::2] = torch.sin(at * rate), torch.cos(at * rate)
        self.register_buffer("pos_enc", table[None])


class VisionEncoder(nn.Module):
    """``NoMaD_ViNT``."""

    def __init__(self, config):
        super().__init__()
        dim, out = config.dim, efficientnet.features(config.trunk_width)
        self.context = config.context
        self.obs_encoder, self.goal_encoder = EfficientNet(config, 3), EfficientNet(config, 6)
        self.compress_obs_enc, self.compress_goal_enc = nn.Linear(out, dim), nn.Linear(out, dim)
        self.positional_encoding = Positions(dim, config.context + 2)
        self.sa_layer = nn.TransformerEncoderLayer(
            dim, config.heads, 4 * dim, activation="gelu", batch_first=True, norm_first=True
        )
        self.sa_encoder = nn.TransformerEncoder(
            self.sa_layer, config.layers, enable_nested_tensor=False
        )

    def forward(self, seen, goal, hidden):
        """Pictures stacked along colours, as the original takes them."""
        batch, count = len(seen), self.context + 2
        both = torch.cat([seen[:, 3 * self.context :], goal], 1)
        goal = self.compress_goal_enc(self.goal_encoder(both))[:, None]
        each = torch.concat(torch.split(seen, 3, 1), 0)
        tokens = self.compress_obs_enc(self.obs_encoder(each))
        tokens = tokens.reshape(self.context + 1, batch, -1).transpose(0, 1)
        tokens = torch.cat([tokens, goal], 1) + self.positional_encoding.pos_enc
        mask = torch.zeros(batch, count, dtype=torch.bool)
        mask[:, -1] = hidden
        tokens = self.sa_encoder(tokens, src_key_padding_mask=mask)
        weight = torch.where(
            hidden[:, None], (1 - mask.float()) * count / (count - 1), torch.ones(batch, count)
        )
        return (tokens * weight[..., None]).mean(1)


class Wave(nn.Module):
    """``SinusoidalPosEmb``."""

    def __init__(self, dim):
        super().__init__()
        self.half = dim // 2

    def forward(self, time):
        rate = torch.exp(torch.arange(self.half) * (-math.log(10000) / (self.half - 1)))
        angle = time[:, None] * rate[None]
        return torch.cat([angle.sin(), angle.cos()], -1)


class Conv1dBlock(nn.Module):
    """``Conv1dBlock``."""

    def __init__(self, inward, outward, kernel, groups=8):
        super().__init__()
        conv = nn.Conv1d(inward, outward, kernel, padding=kernel // 2)
        self.block = nn.Sequential(conv, nn.GroupNorm(groups, outward), nn.Mish())

    def forward(self, x):
        return self.block(x)


class Residual(nn.Module):
    """``ConditionalResidualBlock1D``."""

    def __init__(self, inward, outward, condition, kernel, groups):
        super().__init__()
        first = Conv1dBlock(inward, outward, kernel, groups)
        self.blocks = nn.ModuleList([first, Conv1dBlock(outward, outward, kernel, groups)])
        self.cond_encoder = nn.Sequential(nn.Mish(), nn.Linear(condition, outward))
        same = inward == outward
        self.residual_conv = nn.Identity() if same else nn.Conv1d(inward, outward, 1)

    def forward(self, x, told):
        inner = self.blocks[0](x) + self.cond_encoder(told)[..., None]
        return self.blocks[1](inner) + self.residual_conv(x)


class Resize(nn.Module):
    """``Downsample1d`` and ``Upsample1d``."""

    def __init__(self, conv):
        super().__init__()
        self.conv = conv

    def forward(self, x):
        return self.conv(x)


class Unet(nn.Module):
    """``ConditionalUnet1D``."""

    def __init__(self, config):
        super().__init__()
        time, widths = config.time_dim, (2, *config.channels)
        block = functools.partial(
            Residual, condition=time + config.dim, kernel=config.kernel, groups=config.groups
        )
        self.diffusion_step_encoder = nn.Sequential(
            Wave(time), nn.Linear(time, 4 * time), nn.Mish(), nn.Linear(4 * time, time)
        )
        pairs = list(itertools.pairwise(widths))
        self.down_modules, self.up_modules = nn.ModuleList(), nn.ModuleList()
        for level, (inward, outward) in enumerate(pairs):
            last = level == len(pairs) - 1
            half = nn.Identity() if last else Resize(nn.Conv1d(outward, outward, 3, 2, 1))
            self.down_modules.append(
                nn.ModuleList([block(inward, outward), block(outward, outward), half])
            )
        self.mid_modules = nn.ModuleList(block(widths[-1], widths[-1]) for _ in range(2))
        for inward, outward in reversed(pairs[1:]):
            twice = Resize(nn.ConvTranspose1d(inward, inward, 4, 2, 1))
            self.up_modules.append(
                nn.ModuleList([block(2 * outward, inward), block(inward, inward), twice])
            )
        self.final_conv = nn.Sequential(
            Conv1dBlock(widths[1], widths[1], config.kernel), nn.Conv1d(widths[1], 2, 1)
        )

    def forward(self, sample, time, condition):
        x, kept = sample.transpose(1, 2), []
        told = torch.cat([self.diffusion_step_encoder(time), condition], -1)
        for one, two, half in self.down_modules:
            kept.append(two(one(x, told), told))
            x = half(kept[-1])
        for block in self.mid_modules:
            x = block(x, told)
        for one, two, twice in self.up_modules:
            x = twice(two(one(torch.cat([x, kept.pop()], 1), told), told))
        return self.final_conv(x).transpose(1, 2)


class Distance(nn.Module):
    """``DenseNetwork``."""

    def __init__(self, dim):
        super().__init__()
        self.network = nn.Sequential(
            nn.Linear(dim, dim // 4),
            nn.ReLU(),
            nn.Linear(dim // 4, dim // 16),
            nn.ReLU(),
            nn.Linear(dim // 16, 1),
        )


class Reference(nn.Module):
    """``NoMaD``, with random norms."""

    def __init__(self, config):
        super().__init__()
        torch.manual_seed(0)
        self.vision_encoder = VisionEncoder(config)
        self.noise_pred_net = Unet(config)
        self.dist_pred_net = Distance(config.dim)
        with torch.no_grad():
            for layer in self.modules():
                if isinstance(layer, nn.GroupNorm | nn.LayerNorm):
                    layer.weight.uniform_(0.5, 1.5)
                    layer.bias.normal_(0, 0.2)
        self.eval()


def saved(reference, path, **changes):
    torch.save({**reference.state_dict(), **changes}, path)
    return path


def apart(ours, theirs):
    theirs = theirs.detach().numpy()
    assert ours.shape == theirs.shape
    return np.abs(np.asarray(ours) - theirs).max() / np.abs(theirs).max()


def compare(config, reference, params, batch):
    rng = np.random.default_rng(batch)
    count = config.context + 1
    seen = rng.normal(size=(batch, count, config.height, config.width, 3)).astype(np.float32)
    goal = rng.normal(size=(batch, config.height, config.width, 3)).astype(np.float32)
    hidden = np.arange(batch) % 2 == 1
    noisy = rng.normal(size=(batch, config.waypoints, 2)).astype(np.float32)
    time = rng.integers(0, 10, batch)

    @jax.jit
    def ours(params):
        condition = nomad.encode(config, params, seen, goal, hidden)
        made = nomad.denoise(config, params, noisy, time, condition)
        return condition, made, nomad.distance(config, params, condition)

    stacked = torch.tensor(np.moveaxis(seen, -1, 2)).flatten(1, 2)
    with torch.no_grad():
        condition = reference.vision_encoder(
            stacked, torch.tensor(np.moveaxis(goal, -1, 1)), torch.tensor(hidden)
        )
        made = reference.noise_pred_net(torch.tensor(noisy), torch.tensor(time), condition)
        far = reference.dist_pred_net.network(condition)[:, 0]
    return [apart(*pair) for pair in zip(ours(params), (condition, made, far), strict=True)]


@pytest.fixture(scope="module")
def pair():
    return Reference(SMALL)


@pytest.mark.parametrize("batch", [3])
def test_it_equals_the_reference_in_odd_sizes(pair, tmp_path, batch):
    config, params = converter.read(saved(pair, tmp_path / "nomad.pth"), SMALL)
    assert config == SMALL
    assert max(compare(config, pair, params, batch)) < 1e-4


@pytest.mark.slow
def test_the_published_sizes_have_the_published_names_and_shapes():
    with torch.device("meta"):
        published = Reference.__new__(Reference)
        nn.Module.__init__(published)
        published.vision_encoder = VisionEncoder(NomadConfig())
        published.noise_pred_net, published.dist_pred_net = Unet(NomadConfig()), Distance(256)
    state = published.state_dict()
    listed = {entry.name: entry for entry in converter.entries(NomadConfig())}
    left = state.keys() - listed.keys()
    assert not listed.keys() - state.keys()
    assert {name.split(".")[1] for name in left} == {
        "obs_encoder",
        "goal_encoder",
        "sa_layer",
        "positional_encoding",
    }
    shapes = nomad.shapes(NomadConfig())
    assert {entry.path for entry in listed.values()} == shapes.keys()
    for name, entry in listed.items():
        turned = entry.transform.read(np.broadcast_to(np.zeros(()), tuple(state[name].shape)))
        assert turned.shape == shapes[entry.path]


def test_the_number_of_earlier_pictures_is_read_from_the_file(pair, tmp_path):
    other = dataclasses.replace(SMALL, context=3)
    assert converter.read(saved(pair, tmp_path / "nomad.pth"), other)[0] == SMALL


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"vision_encoder.more": torch.zeros(1)}, "beside those of NoMaD"),
        ({"dist_pred_net.network.0.bias": torch.zeros(5)}, "distance_0/bias has shape"),
        ({"dist_pred_net.network.0.weight": torch.zeros(5)}, "distance_0/kernel has shape"),
    ],
)
def test_other_tensors_are_refused(pair, tmp_path, changes, words):
    with pytest.raises(UserError, match=words):
        converter.read(saved(pair, tmp_path / "nomad.pth", **changes), SMALL)


def test_an_incomplete_file_is_refused(pair, tmp_path):
    state = pair.state_dict()
    del state["noise_pred_net.final_conv.1.bias"]
    torch.save(state, tmp_path / "nomad.pth")
    with pytest.raises(UserError, match=r"lacks noise_pred_net\.final_conv\.1\.bias"):
        converter.read(tmp_path / "nomad.pth", SMALL)


@pytest.mark.parametrize("levels", [10, 3])
def test_levels_and_steps_equal_those_of_diffusers(levels):
    diffusers = pytest.importorskip("diffusers")
    theirs = diffusers.DDPMScheduler(
        num_train_timesteps=levels,
        beta_schedule="squaredcos_cap_v2",
        clip_sample=True,
        prediction_type="epsilon",
    )
    theirs.set_timesteps(levels)
    assert np.allclose(squared_cosine.alphas_cumprod(levels), theirs.alphas_cumprod, atol=1e-7)
    rng = np.random.default_rng(0)
    draw = lambda: rng.normal(size=(3, 4, 2)).astype(np.float32)  # noqa: E731
    clean, noise, at = draw(), draw(), np.array([0, levels // 2, levels - 1])
    noisy = theirs.add_noise(*map(torch.from_numpy, (clean, noise, at)))
    assert np.allclose(squared_cosine.corrupt(levels, clean, noise, at), noisy, atol=1e-6)
    back, x = jax.jit(squared_cosine.back, static_argnums=0), draw()
    for time in theirs.timesteps.tolist():
        predicted, noise = np.tanh(x) + 0.1 * time, draw()
        module = "diffusers.schedulers.scheduling_ddpm.randn_tensor"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, lambda *_, given=noise, **__: torch.from_numpy(given))
            want = theirs.step(torch.from_numpy(predicted), time, torch.from_numpy(x)).prev_sample
        got = np.array(back(levels, predicted, x, time, noise))
        assert np.abs(got - want.numpy()).max() < 1e-5 * max(1, np.abs(x).max())
        x = got
    assert np.abs(x).max() <= 1
