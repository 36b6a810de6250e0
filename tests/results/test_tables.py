"""Text tables: columns as wide as their longest text, aligned as asked."""

from jaxslam.results.tables import format_table


def test_columns_are_aligned_as_asked():
    rows = [("seed", "ESS", "verdict"), ("1", "20.1", "good"), ("mean", "3", "")]
    assert format_table(rows, ">><").splitlines() == [
        "seed   ESS  verdict",
        "   1  20.1  good",
        "mean     3",
    ]
