"""The files of weights whose origin and digest are known."""

from __future__ import annotations

from dataclasses import dataclass

# What each matcher needs; of alternatives the preferred first.
NETWORKS_OF: dict[str, tuple[tuple[str, ...], ...]] = {
    "xfeat": (("xfeat",),),
    "xfeat-star": (("xfeat",),),
    "xfeat-lighterglue": (("xfeat",), ("lighterglue",)),
    "raft": (("raft-small", "raft-large"),),
}


@dataclass(frozen=True, slots=True)
class KnownWeights:
    """A file of weights that somebody published.

    Args:
        network: "xfeat", "lighterglue", "raft-small" or "raft-large".
        file: Its name.
        sha256: Its digest, in hexadecimal.
        size_bytes: Its size, where it is known.
        licence: SPDX identifier.
        source: Who published it.
        url: Where it, or the archive it is in, can be fetched; None where it cannot.
        member: Its name in the archive; None where the address is the file's own.
        archive_sha256: The archive's digest; None where there is no archive.
        note: What to know before using it.
    """

    network: str
    file: str
    sha256: str
    size_bytes: int | None
    licence: str
    source: str
    url: str | None = None
    member: str | None = None
    archive_sha256: str | None = None
    note: str = ""


_XFEAT = "https://github.com/verlab/accelerated_features/raw/main/weights/"
_RAFT = "https://dl.dropboxusercontent.com/s/4j4z58wuv8o0mfz/models.zip"
_RAFT_SHA256 = "4be6101b271f58ec49866da5cf609fd17e86e9cae2483f70630ef4a295dc66bd"
_XFEAT_SOURCE = "XFeat's authors (verlab/accelerated_features)"
_RAFT_SOURCE = "RAFT's authors (princeton-vl/RAFT, download_models.sh)"


def _raft(network: str, file: str, sha256: str, size_bytes: int | None, note: str) -> KnownWeights:
    return KnownWeights(
        network, file, sha256, size_bytes, "BSD-3-Clause", _RAFT_SOURCE,
        _RAFT, f"models/{file}", _RAFT_SHA256, note,
    )  # fmt: skip


# In order of preference within a network. The publishers state no digests: these are the ones that independent projects
# pin for the files fetched from there, and for the small RAFT and the converted files those of the files themselves.
KNOWN: tuple[KnownWeights, ...] = (
    KnownWeights(
        "xfeat",
        "xfeat.pt",
        "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
        6247949,
        "Apache-2.0",
        _XFEAT_SOURCE,
        _XFEAT + "xfeat.pt",
    ),
    KnownWeights(
        "xfeat",
        "xfeat_kornia.safetensors",
        "080a122eb82d65ebc4e196c96b7e076a0020eebf6c923af732ef50bf9bf35d96",
        6218080,
        "Apache-2.0",
        "converted from an ONNX export of XFeat's weights",
        note="normalisation folded into the convolutions: the same function when evaluated, not to be trained on",
    ),
    KnownWeights(
        "lighterglue",
        "xfeat-lighterglue.pt",
        "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
        None,
        "Apache-2.0",
        _XFEAT_SOURCE,
        _XFEAT + "xfeat-lighterglue.pt",
        note="all six layers; holds the XFeat it was trained with, too",
    ),
    KnownWeights(
        "lighterglue",
        "xfeat_lighterglue_L3_kornia.safetensors",
        "6e9e65ac0cbfa10554f85b93b7e9c3b42de4f2b49e34a00ad69b56478cc00273",
        2195980,
        "Apache-2.0",
        "converted from an ONNX export of LighterGlue's weights",
        note="the first three of six layers",
    ),
    _raft(
        "raft-small",
        "raft-small.pth",
        "c7d41b9cc88442bb8aa911dbb33086dac55a226394b142937ff22d5578717332",
        3984814,
        "1 million parameters",
    ),
    _raft(
        "raft-large",
        "raft-things.pth",
        "fcfa4125d6418f4de95d84aec20a3c5f4e205101715a79f193243c186ac9a7e1",
        21108000,
        "5.3 million parameters; trained on FlyingChairs and FlyingThings3D",
    ),
    _raft(
        "raft-large",
        "raft-sintel.pth",
        "90630d2e7d488a0d3ccb5e8194524850c4c05c732ea4ff99799822c7fa5c5cbf",
        None,
        "then on Sintel",
    ),
    _raft(
        "raft-large",
        "raft-kitti.pth",
        "b9d170362415e1a27bd8402ee966a3ddf0d60df9b2df2c0b4949f5ced490a9e6",
        None,
        "then on KITTI",
    ),
    _raft(
        "raft-large",
        "raft-chairs.pth",
        "c6c75465cf995d137f89ca2e2d08594ed390befbb8859f7f65c48bcc8feb0fd7",
        None,
        "trained on FlyingChairs only",
    ),
)


def matchers_of(network: str) -> list[str]:
    """The matchers that need a network, or can use it."""
    return [matcher for matcher, needs in NETWORKS_OF.items() if any(network in group for group in needs)]
