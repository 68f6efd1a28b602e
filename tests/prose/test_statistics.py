from places import ROOT

from tests.prose.statistics import longest_without_heading, main, pages, statistics


def values(text: str) -> list[float]:
    return [one.value for one in statistics({"page.md": text})]


def test_every_number_is_what_it_counts():
    text = "# Nine words of a heading that is no prose\n\nYou see two words. We have 3 eggs.\n\n| 1 | 2 |\n"
    assert values(text) == [4, 4, 100 / 8, 200 / 8, 8]
    assert [one.holds for one in statistics({"page.md": text})] == [True, True, False, True, True]


def test_words_are_counted_from_heading_to_heading():
    assert longest_without_heading("a b c\n\n## d\n\ne f\n\n| x y z z z z |\n\ng\n") == 3
    assert longest_without_heading("a b\n\n" * 70) == 140


def test_long_sentences_and_missing_readers_break_the_limits():
    text = " ".join(["word"] * 26) + ".\n"
    assert [one.holds for one in statistics({"page.md": text})] == [False, False, True, False, True]


def test_the_pages_keep_the_limits(capsys):
    assert len(pages(ROOT)) > 15
    assert main([str(ROOT)]) == 0, capsys.readouterr().out
