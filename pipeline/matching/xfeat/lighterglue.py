"""LighterGlue by kornia: XFeat keypoints matched by a network that sees all of them, and may match in the band only.

LightGlue (Lindenberger, Sarlin and Pollefeys, ICCV 2023) as trained for XFeat. Before the last step, the assignment,
pairs out of reach are closed: what is assigned is the best of what the pose allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from kornia.feature import LightGlue
from kornia.feature.lightglue import filter_matches, normalize_keypoints, sigmoid_log_double_softmax

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.poses import RelativePose
from pipeline.matching.devices import in_batches
from pipeline.matching.features import Features
from pipeline.matching.matcher import Candidates, SearchLimits, View
from pipeline.matching.reach import Reach
from pipeline.matching.weights.files import FoundWeights, load_state, strict_load, wrong_network
from pipeline.matching.xfeat.sparse import XFeatExtractor

_REF_BLOCK = 256
# The similarity of pairs out of reach: next to no probability, and still a number.
_CLOSED = -1e4
# Names of the published file beside those of kornia's module; only the last layer's assignment is used.
_PREFIX = "matcher."
_UNUSED = ("log_assignment.", "token_confidence.", "confidence_thresholds")


@dataclass(frozen=True)
class LighterGlueNetwork:
    """The matching network on its device, loaded when it is first needed.

    Args:
        weights: Its weights file; it tells the number of layers.
        device: What it runs on.
        notes: As `XFeatNetwork`.
        threshold: Least probability of a match, the network's own.
    """

    weights: FoundWeights
    device: torch.device
    notes: list[str]
    threshold: float = 0.1

    @cached_property
    def model(self) -> LightGlue:
        """The network.

        Raises:
            InputError: The weights are damaged, or of another network.
        """
        state = _matcher_part(load_state(self.weights))
        layers = 1 + max((int(name.split(".")[1]) for name in state if name.startswith("transformers.")), default=-1)
        if not layers:
            raise wrong_network(self.weights, "LighterGlue", list(state))
        model = LightGlue(
            None,  # type: ignore[arg-type]  # by its documentation: no file of its own is downloaded
            input_dim=64,
            descriptor_dim=96,
            n_layers=layers,
            num_heads=1,
            # Every point goes through every layer: a pair's matches then depend on nothing but the pair.
            depth_confidence=-1,
            width_confidence=-1,
        )
        strict_load(model, _with_unused(state, model), self.weights)
        return model.eval()

    def match(self, ref: Points, src: Points, reach: Reach) -> tuple[Ints, Ints, Floats]:
        """Indices of ref and src points that belong together, and their probability."""
        if not (len(ref.features.pixels) and len(src.features.pixels)):
            none = np.empty(0, np.int64)
            return none, none, np.empty(0)
        (found,) = in_batches(
            lambda pairs, device: [self._run(*pair, device) for pair in pairs],
            [(ref, src, reach)],
            self.device,
            1,
            self.notes,
        )
        return found

    def _run(self, ref: Points, src: Points, reach: Reach, device: torch.device) -> tuple[Ints, Ints, Floats]:
        model = self.model.to(device)
        with torch.inference_mode():
            (in_ref, place_ref), (in_src, place_src) = (
                (
                    model.input_proj(torch.from_numpy(points.features.descriptors)[None].to(device)),
                    model.posenc(points.normalised().to(device)),
                )
                for points in (ref, src)
            )
            for layer in model.transformers:
                in_ref, in_src = layer(in_ref, in_src, place_ref, place_src)
            last = model.log_assignment[-1]
            matchable = last.get_submodule("matchability")
            closed = torch.from_numpy(~_allowed(reach, in_ref.shape[1], in_src.shape[1]))[None].to(device)
            similarity = last(in_ref, in_src)[1].masked_fill_(closed, _CLOSED)
            scores = sigmoid_log_double_softmax(similarity, matchable(in_ref), matchable(in_src))
            # A point with no open pair at all would share its probability among closed ones.
            scores[:, :-1, :-1].masked_fill_(closed, -torch.inf)
            partner, _, score, _ = filter_matches(scores, self.threshold)
        column = partner[0].cpu().numpy()
        rows = np.flatnonzero(column >= 0)
        return rows, column[rows], score[0].cpu().numpy()[rows].astype(np.float64)


@dataclass(frozen=True, slots=True)
class Points:
    """Features of an image of known size.

    Args:
        features: The features.
        width: Of the image.
        height: Of the image.
    """

    features: Features
    width: int
    height: int

    def normalised(self) -> torch.Tensor:
        """(1, n, 2) float32, the longer side of the image from -1 to 1: as the network was trained."""
        size = torch.tensor([[self.width, self.height]], dtype=torch.float32)
        return normalize_keypoints(torch.from_numpy(self.features.pixels.astype(np.float32))[None], size)


def _allowed(reach: Reach, n_ref: int, n_src: int) -> Bools:
    columns = np.arange(n_src)
    return np.concatenate(
        [
            reach.allows(np.arange(start, min(start + _REF_BLOCK, n_ref))[:, None], columns[None])
            for start in range(0, n_ref, _REF_BLOCK)
        ]
    )


def _matcher_part(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The matcher's parameters by kornia's names; the published file holds its extractor's too."""
    own = {name: value for name, value in state.items() if name.startswith(_PREFIX)} or state
    return {_kornia_name(name.removeprefix(_PREFIX)): value for name, value in own.items()}


def _kornia_name(short: str) -> str:
    kind, _, rest = short.partition(".")
    if kind not in {"self_attn", "cross_attn"}:
        return short
    layer, _, rest = rest.partition(".")
    return f"transformers.{layer}.{kind}.{rest}"


def _with_unused(state: dict[str, torch.Tensor], model: LightGlue) -> dict[str, torch.Tensor]:
    """The file's parameters and, where it lacks those that are never used here, the module's own."""
    own = model.state_dict()
    last = f"log_assignment.{len(model.transformers) - 1}."
    unused = {name: value for name, value in own.items() if name.startswith(_UNUSED) and not name.startswith(last)}
    return {**unused, **state}


@dataclass(frozen=True, slots=True)
class LighterGlueMatcher:
    """XFeat's keypoints matched by LighterGlue in the band.

    Args:
        extractor: Finds the features.
        network: Matches them.
    """

    extractor: XFeatExtractor
    network: LighterGlueNetwork
    colour: bool = False

    def candidates(self, ref: View, src: View, pose: RelativePose, limits: SearchLimits) -> Candidates:
        """As `Matcher.candidates`; the score is the network's probability."""
        reach = limits.reach(ref.features.pixels, ref.camera, src.features.pixels, src.camera, pose)
        in_ref, in_src = (Points(view.features, view.camera.width, view.camera.height) for view in (ref, src))
        rows, columns, score = self.network.match(in_ref, in_src, reach)
        return Candidates.of_features(ref, src, (rows, columns), score, limits)
