"""The kinds of pools, and the arguments by which ``make_pool`` makes each."""

POOLS = {
    "native": {"backend": "native"},
    "process": {"backend": "auto", "isolation": "process", "workers": 1},
}
