"""The kinds of pools, and the arguments by which ``make_pool`` makes each."""

POOLS = {
    "python": {"backend": "python"},
    "native": {"backend": "native"},
    "process": {"backend": "auto", "isolation": "process", "workers": 1},
}
