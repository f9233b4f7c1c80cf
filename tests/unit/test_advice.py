"""Names that may have been meant."""

from softwarp.advice import close_to, nearest


def test_close_names_are_told_the_likest_first():
    assert close_to("trian", ["train", "eval", "render"]) == ["train"]
    assert close_to("cart", ["carts", "card", "seat"], count=1) == ["carts"]
    assert close_to("trunk", ["eval"]) == []


def test_case_does_not_count():
    assert close_to("TRUNK", ["Trunk", "trunk"]) == ["Trunk", "trunk"]


def test_all_names_are_told_where_none_is_near():
    assert nearest("trnk", ("trunk", "diamond")) == "did you mean 'trunk'?"
    assert nearest("zzz", ("trunk", "diamond")) == "valid names are 'diamond', 'trunk'"
