"""The input and output of a segmentation model: the user's YAML file beside the model."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from semloc_logs.errors import SettingsError
from semloc_logs.labels.space import LabelSpace, is_file_name, plain, read_space, space_of_names
from semloc_logs.settings import read_yaml


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Input(_Part):
    """The picture as the model wants it: value = (pixel * scale - mean) / std for each channel."""

    name: str | None = Field(None, description="name of the input; default: the model's only one")
    size: tuple[int, int] = Field(description="height and width (pixels)")
    layout: Literal["NCHW", "NHWC"] = "NCHW"
    colours: Literal["RGB", "BGR"] = Field("RGB", description="order of the channels")
    type: Literal["float32", "uint8"] = "float32"
    scale: float = Field(1 / 255, description="factor of the pixels, 0 to 255, before mean and std")
    mean: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="in the order of the channels"
    )
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    resize: Literal["stretch", "letterbox"] = Field(
        "stretch", description="letterbox keeps the aspect ratio and fills with black"
    )
    crop: tuple[float, float, float, float] = Field(
        (0.0, 0.0, 0.0, 0.0),
        description="shares of the picture cut off first: top, bottom, left, right (a bonnet); "
        "they get no label",
    )

    @model_validator(mode="after")
    def _check(self) -> Input:
        if not all(1 <= s <= 16384 for s in self.size):
            raise ValueError("size has to be [height, width] in pixels, each 1 to 16384")
        if not all(s > 0 for s in self.std):
            raise ValueError("std has to be positive")
        top, bottom, left, right = self.crop
        if min(self.crop) < 0 or top + bottom >= 1 or left + right >= 1:
            raise ValueError("crop has to be shares from 0 that leave something of the picture")
        return self


class Output(_Part):
    """The model's output: ``logits`` or probabilities by class and pixel, or class ``ids``."""

    name: str | None = Field(None, description="name of the output; default: the first")
    kind: Literal["logits", "ids"] = "logits"
    layout: Literal["CHW", "HWC"] = Field("CHW", description="of logits")


class Spec(_Part):
    """The whole file.

    Classes come from a label ``space`` (a name or a YAML file) or from a list ``classes`` of names,
    by id.
    """

    input: Input
    output: Output = Output()
    space: str | None = None
    classes: tuple[str, ...] | None = None
    ignore: tuple[str | int, ...] = Field(
        (), description="classes, by name or id, that become unlabelled"
    )

    @model_validator(mode="after")
    def _check(self) -> Spec:
        if (self.space is None) == (self.classes is None):
            raise ValueError("give either 'space' (a label space) or 'classes' (a list of names)")
        return self

    def label_space(self, where: Path) -> LabelSpace:
        """The meaning of the model's ids.

        A YAML file of a space lies relative to the spec file ``where``.
        """
        if self.classes is not None:
            return space_of_names(dict(enumerate(self.classes)), str(where))
        name = self.space or ""
        beside = where.parent / name
        return read_space(str(beside) if is_file_name(name) and beside.exists() else name)

    def ignored(self, space: LabelSpace) -> set[int]:
        """Ids that become unlabelled. SettingsError for a class that is not there."""
        ids = set[int]()
        for wanted in self.ignore:
            matching = {
                i
                for i, n in space.names.items()
                if i == wanted or (isinstance(wanted, str) and plain(n) == plain(wanted))
            }
            if not matching:
                raise SettingsError(
                    f"The spec of the model ignores '{wanted}': {space.name} has no such class."
                )
            ids |= matching
        return ids


def read_spec(path: Path) -> Spec:
    """The spec file ``path``.

    SettingsError that names the key when it is unknown or its value impossible.
    """
    content = read_yaml(path, "Spec")
    try:
        return Spec.model_validate(content)
    except ValidationError as problem:
        first = problem.errors()[0]
        key = ".".join(str(p) for p in first["loc"])
        raise SettingsError(
            f"Spec {path}: {f'{key}: ' if key else ''}{first['msg'].removeprefix('Value error, ')}."
        ) from None
