"""Text for messages: shortened sentences, and the edit distance between two words."""

_LETTERS = 500  # of a message


def shorten(text: str) -> str:
    """Return a message without its middle if it is long.

    A message that quotes a damaged file can have megabytes. Its start says what is wrong, and its
    end what to do, so these are kept.
    """
    if len(text) <= _LETTERS:
        return text
    return f"{text[:350]} ... {text[-140:]}"


def edit_distance(one: str, other: str) -> int:
    """Return the edit distance of two words, with exchanged neighbours as one edit.

    It is the number of letters that must be added, removed, replaced or exchanged with the next
    one (optimal string alignment). People exchange letters as often as they forget one, so that
    counts once: "gelsihgt" is as near to "gelsight" as "gelsigt" is.
    """
    # Rows of the usual table of distances between beginnings of the two words. An exchange looks
    # two rows back, so two rows are kept.
    before_last = list[int]()
    last = list(range(len(other) + 1))
    for i, letter in enumerate(one):
        row = [i + 1]
        for j, wanted in enumerate(other):
            removed = last[j + 1] + 1
            added = row[j] + 1
            replaced = last[j] + (letter != wanted)
            distance = min(removed, added, replaced)
            is_exchange = i > 0 and j > 0 and letter == other[j - 1] and one[i - 1] == wanted
            if is_exchange:
                distance = min(distance, before_last[j - 1] + 1)
            row.append(distance)
        before_last = last
        last = row
    return last[-1]
