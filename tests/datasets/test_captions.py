import asyncio
import base64
import json
import sys
import threading
import time

import cv2
import numpy as np
import pytest
from chat_server import GOOD, KEY, chat, serve
from refused import refused

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import close_shards
from anytouch_jax.datasets import captions
from anytouch_jax.datasets.captions import AnnotateError, Endpoint, annotate, sample_sheet
from anytouch_jax.datasets.prompts import BadAnswer, find_caption_jobs, make_prompt
from anytouch_jax.datasets.shards import pack
from anytouch_jax.files import lock


@pytest.fixture(autouse=True)
def _environment(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    yield
    close_shards()


def end(server, **options):
    return Endpoint(server.url, "gpt-4o", **{"timeout": 5.0, "tries": 3} | options)


async def _ask_at(url, **options):
    client = captions._Client(Endpoint(url, "gpt-4o", **{"timeout": 5.0, "tries": 3} | options))
    async with client.connect() as connection:
        return await client.ask(connection, [{"role": "user", "content": "hello"}])


def _ask(server, **options):
    return asyncio.run(_ask_at(server.url, **options))


FAILED = (captions._QuestionError, BadAnswer, AnnotateError)


def _failed(answer, words, **options):
    """Ask a server that always answers so.

    Return the sentence of the failure and how often it was asked.
    """
    with serve(lambda *_: answer) as server, pytest.raises(FAILED, match=words) as error:
        _ask(server, **options)
    return str(error.value), len(server.asked)


def _rows(count=3, dataset="touch_and_go", **extra):
    """`count` sequences of three frames."""
    return [
        {
            "sequence": f"s{i}",
            "frame_index": k,
            "dataset": dataset,
            "image_path": f"see{i}_{k}.png",
            **extra,
        }
        for i in range(count)
        for k in range(3)
    ]


def _run(manifest, server, folder, **options):
    endpoint = end(server, **options.pop("endpoint", {}))
    return annotate(manifest, endpoint, folder, **{"confirm": lambda _: True} | options)


def _asked(manifest, folder, behave=None, **options):
    """Annotate with a server that answers so.

    Return what was done, and the server, which has stopped.
    """
    with serve(behave) if behave else serve() as server:
        return _run(manifest, server, folder, **options), server


def _images(body):
    return [
        part["image_url"]["url"]
        for part in body["messages"][1]["content"]
        if part["type"] == "image_url"
    ]


def _decoded(url):
    head, data = url.split(",")
    assert head == "data:image/jpeg;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)[
        ..., ::-1
    ]


def _words(body):
    return body["messages"][1]["content"][0]["text"]


def test_one_question_a_sequence_with_the_photograph_of_its_middle_frame(make, tmp_path):
    loose = make(_rows())
    done, server = _asked(loose, tmp_path / "answers", threads=3)
    assert done.manifest.column("text").to_pylist() == [GOOD["caption"]] * 9
    assert (
        len(server.asked) == 3
        and done.requests == 3
        and (done.tokens_in, done.tokens_out) == (300, 60)
    )
    for body, (path, headers) in zip(server.asked, server.heads, strict=True):
        assert path == "/v1/chat/completions" and headers["Authorization"] == f"Bearer {KEY}"
        assert body["model"] == "gpt-4o" and body["response_format"] == {"type": "json_object"}
        assert body["max_tokens"] == 200 and body["temperature"] == 0.0
    # The images are of one colour that tells the row: rows 1, 4, 7 are the middle frames.
    seen = sorted(round(float(_decoded(_images(body)[0])[..., 0].mean())) for body in server.asked)
    assert np.abs(np.array(seen) - [2, 5, 8]).max() <= 1
    assert "RGB image" in _words(server.asked[0])


def test_one_photograph_or_touch_by_two_sensors_is_asked_about_once_with_small_images(
    make, tmp_path
):
    rows = [
        row | {"dataset": "tacquad", "touch": f"p{i // 3}", "image_path": "a.png"}
        for i, row in enumerate(_rows())
    ]
    told = []
    done, server = _asked(
        make(rows), tmp_path / "one", confirm=lambda estimate: told.append(estimate) or True
    )
    assert len(server.asked) == done.requests == told[0].questions == 1
    assert done.manifest.column("text").to_pylist() == [GOOD["caption"]] * 9
    rows = _rows(2, "tacquad", touch="place")
    rows += [{"sequence": "alone", "dataset": "tacquad", "image_path": "big.png"}]
    loose = make(rows)
    cv2.imwrite(str(tmp_path / "big.png"), np.zeros((300, 600, 3), np.uint8))
    done, server = _asked(loose, tmp_path / "answers", side=128)
    assert len(server.asked) == 2 and [len(c.job.rows) for c in done.captions] == [6, 1]
    assert sorted(_decoded(_images(body)[0]).shape for body in server.asked) == [
        (40, 40, 3),
        (64, 128, 3),
    ]


def test_objectfolder_sends_two_photographs_and_the_touch_and_says_so(make, tmp_path):
    loose = make(_rows(1, "objectfolder_real", image2_path="side.png"))
    cv2.imwrite(str(tmp_path / "side.png"), np.full((20, 20, 3), 200, np.uint8))
    done, server = _asked(loose, tmp_path / "answers")
    (body,) = server.asked
    first, second, touch = (_decoded(url) for url in _images(body))
    assert (first.shape, second.shape, touch.shape) == ((40, 40, 3), (20, 20, 3), (12, 16, 3))
    assert abs(second.mean() - 200) < 2
    assert "first two images are RGB images" in _words(
        body
    ) and "last image is the imprint" in _words(body)
    assert [column for _, column in done.captions[0].job.images] == [
        "image_path",
        "image2_path",
        "path",
    ]
    _, server = _asked(make(_rows(1, "objectfolder_real")), tmp_path / "other")
    assert len(_images(server.asked[0])) == 2 and "first image is an RGB image" in _words(
        server.asked[0]
    )


def test_phrases_are_expanded_once_and_kept(make, tmp_path):
    rows = _rows(2, "ssvtp", text='soft, {fuzzy} "wool"')
    rows[3:5] = [
        row | {"dataset": "octopi", "image_path": None, "text": "hard"} for row in rows[3:5]
    ]
    rows[5] |= {"text": None}
    loose = make(rows)
    with serve() as server:
        done = _run(loose, server, tmp_path / "answers")
        words = sorted(map(_words, server.asked))
        assert len(words) == 2 and '"hard"' in words[0] and r'"soft, {fuzzy} \"wool\""' in words[1]
        assert [len(_images(body)) for body in sorted(server.asked, key=_words)] == [0, 1]
        assert done.manifest.column("text").to_pylist() == [GOOD["caption"]] * 5 + [None]
        assert done.manifest.column("phrase").to_pylist() == ['soft, {fuzzy} "wool"'] * 3 + [
            "hard"
        ] * 2 + [None]
        assert done.left_out == {"no phrase to expand": 1}
        refused(
            r"nothing to annotate.*5 rows: expanded before",
            _run,
            done.manifest,
            server,
            tmp_path / "answers",
        )
        # of the phrases, not of what became of them
        again = find_caption_jobs(done.manifest, overwrite=True)[0]
        assert sorted(str(job.phrase) for job in again) == ["hard", 'soft, {fuzzy} "wool"']


def test_what_needs_no_caption_is_left_out_and_counted(make, tmp_path):
    rows = _rows(5)
    for row, change in zip(
        rows[::3],
        (
            {"text": "had one"},
            {"split": "background"},
            {"dataset": "mine"},
            {"image_path": None},
            {},
        ),
        strict=True,
    ):
        at = rows.index(row)
        rows[at : at + 3] = [one | change for one in rows[at : at + 3]]
    loose = make(rows)
    jobs, left_out = find_caption_jobs(loose)
    assert [job.rows.tolist() for job in jobs] == [[12, 13, 14]]
    assert sorted(left_out.values()) == [3, 3, 3, 3]
    assert any(
        "'mine' has no prompt" in reason and "--family mine" in reason for reason in left_out
    )
    several = make([row | {"dataset": f"mine {i % 3}"} for i, row in enumerate(_rows(2))])
    told = refused(r"--family 'mine 2' RGB image", find_caption_jobs, several)
    assert told.count("touch_and_go") == 1
    assert len(find_caption_jobs(loose, families={"mine": "photograph"}, overwrite=True)[0]) == 3
    assert len(find_caption_jobs(loose, split="train")[0]) == 1
    refused("no prompt family 'photo'", find_caption_jobs, loose, families={"mine": "photo"})


def test_nothing_is_asked_before_it_is_confirmed(make, tmp_path):
    estimates = []
    with serve() as server:
        with pytest.raises(AnnotateError, match="not confirmed"):
            _run(
                make(_rows()),
                server,
                tmp_path / "answers",
                confirm=lambda e: estimates.append(e) or False,
                price_in=2.5,
                price_out=10.0,
            )
        assert not server.asked
        _run(make(_rows()), server, tmp_path / "answers", limit=1)
        _run(
            make(_rows()),
            server,
            tmp_path / "answers",
            confirm=lambda e: estimates.append(e) or True,
        )
    first, second = estimates
    words = make_prompt("photograph", 1)
    tokens = 3 * (len(words.system + words.text) // 4 + 85 + 170 + 20)
    assert first == (3, 0, tokens, 240, (tokens * 2.5 + 240 * 10) / 1e6)
    assert (second.questions, second.cached, second.cost) == (2, 1, None) and "no prices" in str(
        second
    )
    assert len(server.asked) == 3


def test_an_answer_is_paid_for_once(make, tmp_path):
    loose = make(_rows(4))
    gate = threading.Barrier(2, timeout=10)

    def behave(number, body):
        if number < 4:
            gate.wait()  # opens only when two are asked at once
        return 200, {}, chat(GOOD)

    with serve(behave) as server:
        first = _run(loose, server, tmp_path / "answers", threads=2)
        assert server.most == 2
        # the same images
        packed = manifests.read(pack(loose, tmp_path / "out"))
        for same in (loose, packed):
            again = _run(
                same, server, tmp_path / "answers", confirm=lambda estimate: estimate.questions == 0
            )
            assert len(server.asked) == 4 and again.requests == 0
            assert again.manifest.column("text") == first.manifest.column("text")
        cv2.imwrite(str(loose.file(1, "image_path")), np.full((9, 9, 3), 7, np.uint8))
        _run(loose, server, tmp_path / "answers")
        assert len(server.asked) == 5  # another image, another question
        _run(loose, server, tmp_path / "answers", endpoint={"max_tokens": 300})
        assert len(server.asked) == 9
    entry = json.loads((tmp_path / "answers" / "answers.jsonl").read_text().splitlines()[0])
    assert (
        entry["model"] == "gpt-4o" and entry["prompt"] == make_prompt("photograph", 1).fingerprint()
    )
    assert entry["caption"] == GOOD["caption"] and entry["object"] == GOOD["object"]


def test_an_interrupted_run_goes_on_and_asks_a_cut_line_again(make, tmp_path):
    loose = make(_rows(8))
    path = tmp_path / "answers" / "answers.jsonl"

    def behave(number, body):
        if number < 4:
            return (200, {}, chat(GOOD))
        return (401, {}, {"error": {"message": "quota"}})

    with (
        serve(behave) as server,
        pytest.raises(AnnotateError, match=r"the key is not accepted; .* 401: quota"),
    ):
        _run(loose, server, tmp_path / "answers", threads=1)
    path.write_bytes(b'[]\n{"key": 3}\n\xff\xfe\n' + path.read_bytes()[:-30])
    with serve() as server:
        done = _run(loose, server, tmp_path / "answers")
        assert len(server.asked) == 5 and len(done.captions) == 8
        _run(loose, server, tmp_path / "answers")
        assert len(server.asked) == 5


def test_a_passing_failure_is_tried_again_and_a_refusal_is_not():
    for status in (408, 409, 429, 503):
        with serve(
            lambda n, _, s=status: (s, {}, b"busy") if n < 2 else (200, {}, chat(GOOD))
        ) as server:
            assert json.loads(_ask(server)[0]) == GOOD
        assert len(server.asked) == 3
    refusal = {"error": {"message": "bad\nimage " + "x" * 999}}
    for status in (400, 413):
        sentence, asked = _failed((status, {}, refusal), f"{status}: bad image x")
        assert asked == 1 and len(sentence) < 300 and "\n" not in sentence


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"<html>busy</html>",
        b"null",
        b"{}",
        b'{"choices": []}',
        b'{"choices": [{"message": null}]}',
        b'{"choices": {"a": 1}}',
        b"[" * 100_000,
        b"\xff\xfe\x00",
        json.dumps(chat("\udfff")).encode(),
    ],
)
def test_an_answer_that_is_no_chat_completion_is_bad(answer):
    _failed((200, {"Content-Type": "application/json"}, answer), "not")


def test_odd_numbers_of_tokens_are_unknown_and_the_answer_is_kept():
    for usage in (
        [],
        {"prompt_tokens": "x"},
        {"prompt_tokens": -7},
        {"prompt_tokens": 10**400, "completion_tokens": 2.5},
    ):
        with serve(lambda *_, usage=usage: (200, {}, chat(GOOD, usage=usage))) as server:
            assert _ask(server) == (json.dumps(GOOD), "stop", 0, 0)


@pytest.mark.parametrize(
    "wait", ["1000000000", "1e999", "Fri, 01 Jan 2100 00:00:00 GMT", "soon", "-5", "\xff"]
)
def test_a_server_that_asks_for_a_long_wait_is_not_obeyed(wait):
    begun = time.monotonic()
    headers = {"Retry-After": wait, "Retry-After-Ms": None}
    _failed((429, headers, {"error": "too many"}), "429: too many and asks to wait", tries=2)
    assert time.monotonic() - begun < 10


def test_waits_for_a_server_are_bounded(monkeypatch):
    assert (
        _failed(("stall", {}, b""), r"no answer within 0\.1 seconds", timeout=0.1, tries=2)[1] == 2
    )
    # a byte now and then, for ever
    drip = (200, {"Content-Length": "400000"}, b"{")
    _failed(drip, r"no answer within 0\.3 seconds", tries=1, timeout=0.3)
    monkeypatch.setattr(captions, "_LONGEST_WAIT", 0.1)
    _failed((429, {"Retry-After-Ms": "60000"}, b""), "no answer", tries=2, timeout=0.1)
    with serve() as server:
        pass
    with pytest.raises(captions._QuestionError, match="cannot be reached"):
        _ask(server, tries=1)  # it has stopped


def test_an_unusable_endpoint_ends_the_waits_of_other_questions(make, tmp_path):
    """The first question is told to wait for a minute.

    The second finds the key refused: the first is not repeated.
    """
    behave = lambda number, _: (401, {}, b"") if number else (429, {"Retry-After-Ms": "60000"}, b"")  # noqa: E731
    with serve(behave) as server, pytest.raises(AnnotateError, match="the key is not accepted"):
        _run(make(_rows(2)), server, tmp_path / "answers", threads=2)
    assert len(server.asked) == 2


def test_bad_answers_are_asked_again_then_counted_and_listed(make, tmp_path):
    answers = [
        "",
        "I'm sorry, I can't help with that.",
        "no JSON",
        {"caption": "soft"},
        {"caption": "word " * 61},
        {"caption": 7},
        ["soft and warm"],
        {"object": "x"},
    ]
    loose = make(_rows(3))

    def behave(number, body):
        row = round(float(_decoded(_images(body)[0])[..., 0].mean()))
        return 200, {}, chat(answers[number % len(answers)] if row < 4 else GOOD)

    done, server = _asked(loose, tmp_path / "answers", behave, threads=2)
    assert len(server.asked) == 3 + 2 and len(done.captions) == 2 and done.requests == 5
    (failure,) = done.failures
    assert failure.rows == 3 and failure.where == loose.where(0) and "bad answer" in failure.reason
    assert "(3 times)" in failure.reason
    (line,) = (tmp_path / "answers" / "failures.jsonl").read_text().splitlines()
    assert json.loads(line) == failure._asdict()
    assert done.manifest.column("text").to_pylist() == [None] * 3 + [GOOD["caption"]] * 6


def test_a_run_of_failures_stops_the_spending(make, tmp_path):
    with (
        serve(lambda *_: (400, {}, {"error": "no such image model"})) as server,
        pytest.raises(
            AnnotateError,
            match=r"25 questions in a row failed, the last one: .*no such image model",
        ),
    ):
        _run(make(_rows(60)), server, tmp_path / "answers", threads=2)
    assert len(server.asked) < 60
    assert threading.active_count() < 8


def test_the_key_is_in_no_file_and_no_message(make, tmp_path, capfd):
    """A server that quotes the key in its answers and its errors, one of which is cut within the
    key.
    """
    said = []
    kinds = (
        (200, {}, chat({"object": KEY, "caption": f"Soft as the key {KEY} in your hand."})),
        (400, {}, {"error": {"message": f"Incorrect key {KEY} provided"}}),
        (200, {}, chat(f"nonsense with {KEY}")),
    )
    with serve(lambda number, _: kinds[number % 3]) as server:
        done = _run(make(_rows(9)), server, tmp_path / "answers", threads=1, log=said.append)
        sample_sheet(done.manifest, done.captions, tmp_path / "sheet.html")
        manifests.write(done.manifest, tmp_path / "new.csv")
    assert done.captions and done.failures and "[key]" in done.captions[0].text
    assert KEY.encode() not in b"".join(
        path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()
    )
    assert KEY not in "".join([*said, *capfd.readouterr(), repr(done.failures), repr(end(server))])
    for status, padding in ((401, ""), (404, ""), (500, ""), (400, ""), (400, "x" * 190)):
        sentence, _ = _failed((status, {}, {"error": f"{padding} bad key {KEY}"}), ".", tries=1)
        assert KEY[:8] not in sentence and ("[key]" in sentence) == (not padding)


def test_the_key_does_not_follow_a_redirect():
    for status in (301, 302, 303, 307, 308):
        with serve() as elsewhere:
            _failed((status, {"Location": elsewhere.url}, b""), "redirects to another address")
        assert not elsewhere.heads


@pytest.mark.parametrize(
    ("url", "key", "words"),
    [
        ("https://api.example.org/v1", "", "set the environment variable OPENAI_API_KEY"),
        ("https://api.example.org/v1", "two words", "does not hold a key"),
        ("https://api.example.org/v1", "line\nInjected: yes", "does not hold a key"),
        ("https://api.example.org/v1", "schlüssel", "does not hold a key"),
        (f"https://me:{KEY}@api.example.org/v1", KEY, "Remove it from --url"),
        ("ftp://api.example.org", KEY, "is not an http or https address"),
        ("api.example.org/v1", KEY, "is not an http"),
        ("http://localhost:port/v1", KEY, "is not an http"),
        ("file:///etc/passwd", KEY, "is not an http"),
    ],
)
def test_bad_addresses_and_keys_are_named_without_showing_the_key(monkeypatch, url, key, words):
    monkeypatch.setenv("OPENAI_API_KEY", key)
    error = refused(words, lambda: Endpoint(url, "m").read_key())
    assert "Injected" not in error and KEY not in error


def test_a_local_server_needs_no_key_and_a_distant_one_is_warned_about(monkeypatch, make, tmp_path):
    assert Endpoint("http://gpu-box:8000/v1", "m").exposes_key
    assert not Endpoint("https://gpu-box:8000/v1", "m").exposes_key
    assert not Endpoint("http://localhost:8000/v1", "m").exposes_key
    monkeypatch.delenv("OPENAI_API_KEY")
    assert not Endpoint("http://gpu-box:8000/v1", "m").exposes_key
    with serve() as server:
        _ask(server)
    assert server.heads[0] == (
        "/v1/chat/completions",
        server.heads[0][1] | {"Authorization": "Bearer none"},
    )
    with serve() as server:
        asyncio.run(_ask_at(f"{server.url}/chat/completions/"))
    assert server.heads[0][0] == "/v1/chat/completions"


def test_a_notebook_may_ask_and_a_missing_client_is_one_sentence(monkeypatch, make, tmp_path):
    async def cell():
        with serve() as server:
            return _run(make(_rows(2)), server, tmp_path / "answers")

    # in a loop that is running
    assert len(asyncio.run(cell()).captions) == 2
    monkeypatch.setitem(sys.modules, "openai", None)
    refused(r"pip install .*annotate", Endpoint("https://api.example.org/v1", "m").read_key)


def test_other_servers_can_be_spoken_to():
    parts = {
        "choices": [{"message": {"content": [{"type": "text", "text": "in "}, {"text": "parts"}]}}],
        "usage": None,
    }
    with serve(lambda *_: (200, {}, parts)) as server:
        answer = _ask(
            server,
            temperature=None,
            json_mode=False,
            token_field="max_completion_tokens",
            max_tokens=9,
        )
    assert answer == ("in parts", "", 0, 0)
    assert set(server.asked[0]) == {"model", "messages", "max_completion_tokens"}
    with serve(lambda *_: (200, {}, chat(None, message={"refusal": "I will not"}))) as server:
        assert _ask(server)[:2] == ("I will not", "refusal")


def test_the_sheet_holds_its_images_and_escapes_words(make, tmp_path):
    loose = make(_rows(5))
    tricky = {"object": "<script>", "caption": "Soft & <b>warm</b> to the touch."}
    done, _ = _asked(loose, tmp_path / "answers", lambda *_: (200, {}, chat(tricky)))
    page = sample_sheet(done.manifest, done.captions, tmp_path / "deep" / "sheet.html", count=3)
    text = page.read_text()
    assert text.count("<article>") == 3 and "3 of 5 captions" in text
    assert "Soft &amp; &lt;b&gt;warm" in text and "<script>" not in text
    sources = [part.split('"')[0] for part in text.split('src="')[1:]]
    assert [_decoded(source).shape for source in sources] == [(40, 40, 3), (12, 16, 3)] * 3
    assert [file.name for file in page.parent.iterdir()] == ["sheet.html"]
    loose.file(1, "image_path").unlink()
    assert (
        "see0_1.png" in sample_sheet(done.manifest, done.captions, tmp_path / "b.html").read_text()
    )
    refused("no captions", sample_sheet, done.manifest, (), tmp_path / "none.html")


def test_many_images_that_cannot_be_read_bar_no_question(make, tmp_path):
    loose = make(_rows(40))
    loose.file(1, "image_path").unlink()
    for job in range(1, 30):
        loose.file(3 * job + 1, "image_path").write_bytes(b"no picture")
    done, server = _asked(loose, tmp_path / "answers")
    assert len(server.asked) == len(done.captions) == 10 and len(done.failures) == 30
    assert "see0_1.png" in done.failures[0].reason and "not a PNG" in done.failures[1].reason
    assert len((tmp_path / "answers" / "failures.jsonl").read_text().splitlines()) == 30


REFUSED = (400, {}, {"error": "no"})


def ten(number, _):
    """Answers to ten questions."""
    if number < 10:
        return (200, {}, chat(GOOD))
    return REFUSED


def test_what_failed_the_last_time_is_asked_last(make, tmp_path):
    loose = make(_rows(40))
    folder = tmp_path / "answers"
    with serve(lambda *_: REFUSED) as server, pytest.raises(AnnotateError, match="in a row failed"):
        _run(loose, server, folder, threads=1)
    assert len((folder / "failures.jsonl").read_text().splitlines()) == 25
    with serve(ten) as server:
        assert len(_run(loose, server, folder, threads=1, limit=35).captions) == 10
    with serve() as server:
        assert len(_run(loose, server, folder).captions) == 40
    assert len(server.asked) == 30


def test_many_questions_that_are_always_refused_do_not_keep_back_the_answers(make, tmp_path):
    done, server = _asked(make(_rows(60)), tmp_path / "answers", ten, threads=1)
    assert len(server.asked) == 35 and len(done.captions) == 10 and len(done.failures) == 50
    assert done.failures[-1].reason.startswith("not asked")
    assert done.manifest.present("text").sum() == 30  # three rows a touch


def test_two_processes_do_not_pay_for_the_same_answers(make, tmp_path):
    loose = make(_rows(3))
    folder = tmp_path / "answers"
    folder.mkdir()
    with (
        serve() as server,
        lock(folder / ".lock"),
        pytest.raises(AnnotateError, match="another process asks for"),
    ):
        _run(loose, server, folder)
    assert not server.asked
    with serve() as server:
        assert len(_run(loose, server, folder).captions) == 3
