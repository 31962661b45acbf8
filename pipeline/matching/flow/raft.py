"""RAFT: dense motion by repeated look-ups in the correlation of all pairs of pixels.

Two encoders give a feature of every eighth pixel of either image, and a context of ref. The inner products of all
pairs of features, averaged over 1, 2, 4 and 8 src cells, are looked up around where each ref cell lies by now; a
recurrent unit makes of them the next step. Parameters are named as in the authors' checkpoints.

Source: Teed and Deng, "RAFT: Recurrent All-Pairs Field Transforms for Optical Flow", ECCV 2020, section 3, appendix;
and the authors' checkpoints for what the paper leaves out (names, the order of the look-ups, no norm in the small
context).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional

from pipeline.engine.errors import InputError

CELL_PX = 8
_LEVELS = 4
# The coarsest level needs a cell of its own: eight cells of eight pixels.
_SMALLEST_PX = CELL_PX * 2 ** (_LEVELS - 1)

Norm = Callable[[int], nn.Module]


@dataclass(frozen=True, slots=True)
class RaftKind:
    """What tells the two published networks apart.

    Args:
        name: For messages and settings.
        features: Size of a cell's feature.
        hidden: Size of the recurrent state.
        context: Size of the context.
        radius: Cells looked up around a place, on each level.
        widths: Of the encoders' four steps.
        gru: Suffix and kernel of the recurrent unit's passes.
        correlation: Widths that the look-ups are brought to.
        motion: Widths that the flow so far is brought to.
        merged: Width of both together.
        head: Width of the flow head.
        mask: Width of the upsampling mask's layer; 0 without a mask.
    """

    name: str
    features: int
    hidden: int
    context: int
    radius: int
    widths: tuple[int, int, int, int]
    gru: tuple[tuple[str, tuple[int, int]], ...]
    correlation: tuple[int, ...]
    motion: tuple[int, int]
    merged: int
    head: int
    mask: int

    @property
    def is_small(self) -> bool:
        """Whether it is the network of bottleneck blocks."""
        return self.mask == 0


SMALL = RaftKind("raft-small", 128, 96, 64, 3, (32, 32, 64, 96), (("", (3, 3)),), (96,), (64, 32), 80, 128, 0)
LARGE = RaftKind(
    "raft-large",
    256,
    128,
    128,
    4,
    (64, 64, 96, 128),
    (("1", (1, 5)), ("2", (5, 1))),
    (256, 192),
    (128, 64),
    126,
    256,
    256,
)


def _conv(inputs: int, outputs: int, kernel: int | tuple[int, int], stride: int = 1) -> nn.Conv2d:
    """A convolution that keeps the size, up to its stride."""
    height, width = (kernel, kernel) if isinstance(kernel, int) else kernel
    return nn.Conv2d(inputs, outputs, (height, width), stride, (height // 2, width // 2))


def _no_norm(_: int) -> nn.Module:
    return nn.Sequential()


class _Block(nn.Module):
    """A residual block: two 3x3 convolutions, or a bottleneck of 1x1, 3x3 and 1x1."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: Norm, *, bottleneck: bool) -> None:
        super().__init__()
        inner = outputs // 4
        steps = (
            ((inputs, inner, 1, 1), (inner, inner, 3, stride), (inner, outputs, 1, 1))
            if bottleneck
            else ((inputs, outputs, 3, stride), (outputs, outputs, 3, 1))
        )
        self.steps = len(steps)
        for i, step in enumerate(steps, 1):
            self.add_module(f"conv{i}", _conv(*step))
            self.add_module(f"norm{i}", norm(step[1]))
        if stride > 1:
            # The checkpoints hold this norm under both names.
            last = norm(outputs)
            self.add_module(f"norm{self.steps + 1}", last)
            self.downsample: nn.Module = nn.Sequential(_conv(inputs, outputs, 1, stride), last)
        else:
            self.downsample = nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        y = x
        for i in range(1, self.steps + 1):
            y = functional.relu(self.get_submodule(f"norm{i}")(self.get_submodule(f"conv{i}")(y)))
        return functional.relu(self.downsample(x) + y)


class _Encoder(nn.Module):
    """An image to one vector for every eighth pixel."""

    def __init__(self, kind: RaftKind, outputs: int, norm: Norm) -> None:
        super().__init__()
        first, *widths = kind.widths
        block = partial(_Block, norm=norm, bottleneck=kind.is_small)
        self.conv1 = _conv(3, first, 7, 2)
        self.norm1 = norm(first)
        layers = []
        for inputs, width, stride in zip(kind.widths, widths, (1, 2, 2), strict=False):
            layers.append(nn.Sequential(block(inputs, width, stride), block(width, width, 1)))
        self.layer1, self.layer2, self.layer3 = layers
        self.conv2 = _conv(widths[-1], outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = functional.relu(self.norm1(self.conv1(x)))
        out: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(x))))
        return out


class _MotionEncoder(nn.Module):
    """Look-ups and the flow so far to motion features; the flow itself is the last two."""

    def __init__(self, kind: RaftKind) -> None:
        super().__init__()
        looked_up = _LEVELS * (2 * kind.radius + 1) ** 2
        first, *more = kind.correlation
        self.convc1 = _conv(looked_up, first, 1)
        self.convc2: nn.Module | None = _conv(first, more[0], 3) if more else None
        self.convf1 = _conv(2, kind.motion[0], 7)
        self.convf2 = _conv(kind.motion[0], kind.motion[1], 3)
        self.conv = _conv(kind.correlation[-1] + kind.motion[1], kind.merged, 3)

    def forward(self, flow: Tensor, looked_up: Tensor) -> Tensor:
        similar = functional.relu(self.convc1(looked_up))
        if self.convc2 is not None:
            similar = functional.relu(self.convc2(similar))
        moved = functional.relu(self.convf2(functional.relu(self.convf1(flow))))
        merged = functional.relu(self.conv(torch.cat([similar, moved], dim=1)))
        return torch.cat([merged, flow], dim=1)


class _Gru(nn.Module):
    """A convolutional gated recurrent unit, in one pass or along rows and columns in turn."""

    def __init__(self, kind: RaftKind) -> None:
        super().__init__()
        inputs = kind.hidden + kind.context + kind.merged + 2
        self.suffixes = [suffix for suffix, _ in kind.gru]
        for suffix, kernel in kind.gru:
            for gate in "zrq":
                self.add_module(f"conv{gate}{suffix}", _conv(inputs, kind.hidden, kernel))

    def forward(self, state: Tensor, x: Tensor) -> Tensor:
        for suffix in self.suffixes:
            update, reset, candidate = (self.get_submodule(f"conv{gate}{suffix}") for gate in "zrq")
            both = torch.cat([state, x], dim=1)
            share = torch.sigmoid(update(both))
            kept = torch.sigmoid(reset(both)) * state
            state = (1 - share) * state + share * torch.tanh(candidate(torch.cat([kept, x], dim=1)))
        return state


class _FlowHead(nn.Module):
    """The recurrent state to a step of the flow."""

    def __init__(self, kind: RaftKind) -> None:
        super().__init__()
        self.conv1 = _conv(kind.hidden, kind.head, 3)
        self.conv2 = _conv(kind.head, 2, 3)

    def forward(self, state: Tensor) -> Tensor:
        out: Tensor = self.conv2(functional.relu(self.conv1(state)))
        return out


class _UpdateBlock(nn.Module):
    """One step of the recurrence."""

    def __init__(self, kind: RaftKind) -> None:
        super().__init__()
        self.encoder = _MotionEncoder(kind)
        self.gru = _Gru(kind)
        self.flow_head = _FlowHead(kind)
        if kind.mask:
            self.mask = nn.Sequential(
                _conv(kind.hidden, kind.mask, 3), nn.ReLU(), _conv(kind.mask, 9 * CELL_PX * CELL_PX, 1)
            )

    def forward(self, state: Tensor, context: Tensor, looked_up: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
        state = self.gru(state, torch.cat([context, self.encoder(flow, looked_up)], dim=1))
        return state, self.flow_head(state)


class _Correlation:
    """Inner products of all pairs of cells, on four levels of src."""

    def __init__(self, ref: Tensor, src: Tensor, radius: int) -> None:
        batch, size, height, width = ref.shape
        products = torch.matmul(ref.flatten(2).transpose(1, 2), src.flatten(2)) / math.sqrt(size)
        level = products.reshape(batch * height * width, 1, height, width)
        self.levels = [level]
        for _ in range(_LEVELS - 1):
            level = functional.avg_pool2d(level, 2)
            self.levels.append(level)
        steps = torch.arange(-radius, radius + 1, device=ref.device, dtype=ref.dtype)
        # The first axis of the window runs along u: so the look-ups are ordered in the checkpoints.
        self.window = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1)

    def look_up(self, cells: Tensor) -> Tensor:
        """The products around places in src.

        Args:
            cells: (b, 2, h, w) u and v in src cells.

        Returns:
            (b, levels x window, h, w); 0 outside src.
        """
        batch, _, height, width = cells.shape
        centres = cells.permute(0, 2, 3, 1).reshape(-1, 1, 1, 2)
        found = []
        for i, level in enumerate(self.levels):
            size = torch.tensor([level.shape[3], level.shape[2]], device=cells.device, dtype=cells.dtype)
            places = (2.0 * (centres / 2**i + self.window) + 1.0) / size - 1.0
            values = functional.grid_sample(level, places, align_corners=False)
            found.append(values.reshape(batch, height, width, -1))
        return torch.cat(found, dim=-1).permute(0, 3, 1, 2).contiguous()


class Raft(nn.Module):
    """The network, ready to be run; see `raft_from_state`.

    Args:
        kind: Small or large.
    """

    def __init__(self, kind: RaftKind) -> None:
        super().__init__()
        self.kind = kind
        self.fnet = _Encoder(kind, kind.features, nn.InstanceNorm2d)
        self.cnet = _Encoder(kind, kind.hidden + kind.context, _no_norm if kind.is_small else nn.BatchNorm2d)
        self.update_block = _UpdateBlock(kind)

    def forward(self, ref: Tensor, src: Tensor, iterations: int) -> Tensor:
        """The motion of every ref pixel.

        Args:
            ref: (b, 3, h, w) float32 red, green, blue, 0..255.
            src: As ref.
            iterations: Steps of the recurrence.

        Returns:
            (b, 2, h, w) px: src pixel minus ref pixel, u then v.
        """
        height, width = ref.shape[2:]
        ref, src = (_padded(image / 127.5 - 1.0) for image in (ref, src))
        features = self.fnet(torch.cat([ref, src]))
        ref_features, src_features = features.chunk(2)
        correlation = _Correlation(ref_features, src_features, self.kind.radius)
        state, context = self.cnet(ref).split([self.kind.hidden, self.kind.context], dim=1)
        state, context = torch.tanh(state), torch.relu(context)
        start = _cells(state)
        flow = torch.zeros_like(start)
        for _ in range(iterations):
            state, step = self.update_block(state, context, correlation.look_up(start + flow), flow)
            flow = flow + step
        fine = _blown_up(flow) if self.kind.is_small else self._by_mask(flow, state)
        return fine[:, :, :height, :width]

    def _by_mask(self, flow: Tensor, state: Tensor) -> Tensor:
        """Every pixel's flow as a convex combination of the 3x3 cells about it (section 3.3)."""
        batch, _, height, width = flow.shape
        # The checkpoints were trained with a quarter of the mask's output.
        weights = (0.25 * self.update_block.mask(state)).reshape(batch, 1, 9, CELL_PX, CELL_PX, height, width)
        around = functional.unfold(CELL_PX * flow, (3, 3), padding=1).reshape(batch, 2, 9, 1, 1, height, width)
        fine = (torch.softmax(weights, dim=2) * around).sum(dim=2)
        return fine.permute(0, 1, 4, 2, 5, 3).reshape(batch, 2, CELL_PX * height, CELL_PX * width)


def raft_from_state(state: Mapping[str, Tensor], where: str = "") -> Raft:
    """The network whose parameters these are, for inference.

    Args:
        state: Name to tensor, as in the authors' checkpoints, with or without their "module." in front.
        where: File they were read from, for messages.

    Raises:
        InputError: They are not RAFT's.
    """
    given = {name.removeprefix("module."): value for name, value in state.items()}
    raft = Raft(LARGE if any(name.startswith("update_block.mask.") for name in given) else SMALL)
    wanted = raft.state_dict()
    for name in wanted.keys() - given.keys():
        if name.endswith(".num_batches_tracked"):
            # A counter of the training, which older checkpoints lack.
            given[name] = wanted[name]
    wrong = sorted(
        name
        for name in wanted.keys() | given.keys()
        if name not in wanted or name not in given or wanted[name].shape != given[name].shape
    )
    if wrong:
        raise InputError(
            "E-WEIGHTS-04",
            "the weights are not RAFT's",
            where=where,
            found=f"{len(state)} tensors: {', '.join(list(state)[:3])}, ...; {len(wrong)} differ: "
            + ", ".join(wrong[:3]),
            expected=f"the {len(wanted)} tensors of {raft.kind.name} by the authors' names (fnet, cnet, update_block)",
            hint="take raft-small.pth or raft-things.pth of the authors' models.zip",
        )
    raft.load_state_dict(given)
    return raft.eval().requires_grad_(requires_grad=False)


def _padded(image: Tensor) -> Tensor:
    """An image with its last row and column repeated up to whole cells, and to the least size."""
    short = (max(-n % CELL_PX, _SMALLEST_PX - n) for n in image.shape[2:])
    bottom, right = short
    return functional.pad(image, (0, right, 0, bottom), mode="replicate") if right or bottom else image


def _cells(like: Tensor) -> Tensor:
    """(b, 2, h, w): u and v of every cell."""
    batch, _, height, width = like.shape
    rows = torch.arange(height, device=like.device, dtype=like.dtype)
    columns = torch.arange(width, device=like.device, dtype=like.dtype)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([u, v]).expand(batch, 2, height, width)


def _blown_up(flow: Tensor) -> Tensor:
    """Cells to pixels by bilinear interpolation with the corners kept, as the small network was trained."""
    fine: Tensor = functional.interpolate(flow, scale_factor=CELL_PX, mode="bilinear", align_corners=True)
    return CELL_PX * fine
