"""Text tables: columns of one width, aligned as asked."""

from jaxslam.results.tables import format_table


def test_columns_are_as_wide_as_their_longest_text_or_wider():
    rows = [("seed", "ESS", "verdict"), ("1", "20.1", "good"), ("mean", "3", "")]
    assert format_table(rows, ">><").splitlines() == [
        "seed   ESS  verdict",
        "   1  20.1  good",
        "mean     3",
    ]
    assert format_table([("a", "b", "c")], "<>", (3, 2)) == "a     b   c"
