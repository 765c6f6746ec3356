"""One error tells all mistakes of a task, each once, with its line and the nearest name."""

import re
import textwrap

import gymnasium
import pytest

import fmugym

# What a line has to be told about stands behind its mistake.
HOUSE = """
    fmu = { bundled = "House" }
    episode_lenght = "1d"                            #! 'episode_length'
    time_step = "15min"
    warm_up = { period = "50min", controller = { u = 0.5 } }  #! 3000
    clock = { from = "01-15", to = "02-15", exclude = "peek" }  #! 'peek'.*'peak'
    terminated = "T_aer > T_sett"                    #! 'T_aer'.*'T_air'.*'T_sett'.*'T_set'
    truncated = "E_sum"                              #! condition.*'E_sum'

    [variables]
    T_air = { unit = "degC", nominl = 20 }           #! 'nominal'
    T_op = { unit = "kg" }                           #! 'kg'
    T_core = { name = "T_aiir" }                     #! 'T_air'
    E_sum = { name = "E", unit = "kWh" }
    I_sol = { min = 9, max = -9, sample = "median" } #! 9 and -9 #! 'median'.*'mean'

    [parameters]
    UAA = 300                                        #! 'UA'
    a_m = 100                                        #! 4.5

    [data]
    weather = { file = "wether.csv", column = 1 }    #! 'wether.csv'
    price = { values = [1, 2], stepp = "1h" }        #! 'step'
    sun = { values = [0, 1], step = "1h", input = "I_sool" }  #! 'I_sol'

    [setpoints]
    T_set = { value = 21, of = "T_opp" }             #! 'T_op'
    goal = { steps = { low = 0, high = 1 } }         #! 'every'
    hot = { value = 24, of = "T_air +" }             #! ends too early
    wave = { sine = { amplitude = 1, periodd = "1h" } }  #! 'period'

    [controllers]
    heat = "pidd of=T_air setpoint=21 kp=1"          #! 'pid'
    less = "pid of=T_air setpoint=21 kpp=1"          #! 'kp'

    [inputs]
    T_out = "weather + priec + 1"                    #! 'priec'.*'price'
    Q_ins = "100"                                    #! 'Q_int'

    [memory]
    sum = { start = 0, update = "sum + T_core + Pp" }  #! 'Pp'.*'P'
    old = { begin = 0 }                              #! 'begin'

    [expressions]
    error = "T_air - T_set + errr"                   #! 'errr'.*'error'
    worse = "2 * error + maxx(1, 2)"                 #! 'maxx'.*'max'
    other = "worse + old + 1 +"                      #! column|early

    [agent]
    actions = ["uu"]                                 #! 'u'
    observations = [
        "T_air", "error", "wrse", "T_set_error", "P",  #! 'wrse'.*'worse'
        "COPP",                                      #! 'COP'
    ]
    forecast = { of = ["price", "prise"], horizon = "2h" }  #! 'prise'.*'price'
    history = { of = "T_airr", length = "50min" }    #! 'T_air' #! 3000
    normalize = "nominel"                            #! 'nominal'

    [reward]
    comfort = "-abs(error) - worse - T_core - E_sm"  #! 'E_sm'.*'E_sum'
    energy = { expr = "-Pe", weigth = 2 }            #! 'Pe'.*'P' #! 'weight'
    switch = "-abs(u - previous(u))"

    [costs]
    heat = { expr = "Q_hpp", limit = "ten" }         #! 'Q_hp' #! 'ten'

    [kpis]
    bill = { sum = "P * pricee" }                    #! 'pricee'.*'price'
    both = "bill + comfort + swich"                  #! 'swich'.*'switch'

    [scenarios]
    peak = { start = "01-15", length = "14d" }
    mild = { start = "15-04", lenght = "14d" }       #! '15-04' #! 'length'

    [foreign]
    preloda = "libx.so"                              #! 'preload'

    [config]
    on_fault = "rais"                                #! 'raise'
"""

SYSTEM = """
    time_step = "1s"
    reward = "-anglee**2"                            #! 'anglee'.*'angle'
    terminated = "done"                              #! 'done' is known in .* 'kpis' and

    [system]
    mastr = "jacobi"                                 #! 'master'
    units = { angel = "deg" }                        #! 'angel'.*'angle'
    connections = [
        "torque -> plant.taau",                      #! 'tau'
        "plant.q -> angle",
        "plnt.q -> other",                           #! 'plnt'.*'plant'
        "broken.q -> third",
    ]

    [system.components]
    plant = { bundled = "Pendulum", start_values = { mm = 1 } }  #! 'm'
    broken = { bundled = "Pendulun" }                #! 'Pendulum'

    [variables]
    tau = { name = "torque", min = -1, max = 1 }

    [agent]
    actions = ["tau"]
    observations = ["angle", "broken.q", "third", "plant.q_dto"]  #! 'plant.q_dto'.*'plant.q_dot'
"""


MISSING = """
    fmu = { bundled = "Pendulum" }
    time_step = "1 ss"
"""


def told(error):
    """The lines and texts of the mistakes that an error tells."""
    found = [
        re.match(r".*wrong\.toml, line (\d+), [^:]*: (.*)", line) for line in error.splitlines()
    ]
    assert all(found), error
    return [(int(one[1]), one[2]) for one in found]


def require_all(text, error):
    """Each mistake is told in its line, and nothing else is told."""
    rest = told(error)
    for number, line in enumerate(text.splitlines(), 1):
        for fact in line.split("#! ")[1:]:
            one = [(n, t) for n, t in rest if n == number and re.search(fact.strip(), t)]
            assert one, (number, line, error)
            rest.remove(one[0])
    assert not rest


@pytest.mark.parametrize("text", [HOUSE, SYSTEM], ids=["house", "system"])
def test_one_error_tells_all_mistakes_of_all_sections(text, tmp_path, refused):
    file = tmp_path / "wrong.toml"
    file.write_text(textwrap.dedent(text))
    with pytest.raises(fmugym.TaskError) as caught:
        gymnasium.make("fmugym/FMU-v0", config=file)
    require_all(textwrap.dedent(text), str(caught.value))
    error = refused("validate", file)
    assert error.splitlines() == [f"fmugym: error: {one}" for one in str(caught.value).splitlines()]


def test_what_is_missing_is_told_with_what_is_wrong(tmp_path):
    file = tmp_path / "wrong.toml"
    file.write_text(textwrap.dedent(MISSING))
    with pytest.raises(fmugym.TaskError) as caught:
        fmugym.load(file)
    error = str(caught.value)
    for fact in ("'1 ss'", "'agent'", "reward"):
        assert fact in error
    assert len(error.splitlines()) == 3


def test_what_may_be_missing_because_of_a_misspelt_key_is_not_told():
    assert mistakes_of(pendulum(reward=None, rewrd="-abs(q)")) == ["rewrd"]


def test_an_unreadable_fmu_is_told_with_the_mistakes_of_the_file():
    assert mistakes_of(pendulum(fmu="nowhere.fmu", reward="1 +")) == ["fmu", "reward"]


def pendulum(**changes):
    variables = {"tau": {"min": -1, "max": 1}}
    agent = {"actions": "tau", "observations": "q"}
    task = {"fmu": {"bundled": "Pendulum"}, "time_step": 0.1, "reward": "-abs(q)"}
    return {**task, "variables": variables, "agent": agent, **changes}


def mistakes_of(task):
    with pytest.raises(fmugym.TaskError) as caught:
        fmugym.load(task)
    return sorted(line.partition(":")[0] for line in str(caught.value).splitlines())


def test_a_variable_that_the_fmu_lacks_hides_no_other_mistake():
    variables = {"tau": {"min": -1, "max": 1}, "nowhere": {"min": 0}}
    task = pendulum(variables=variables, reward="-nowhere", terminated="qq > 1")
    assert mistakes_of(task) == ["terminated", "variables.nowhere"]


CONSEQUENCES = {
    "a section": ({"variables": 3, "reward": "-abs(angle)"}, ["variables"]),
    "a misspelt section": ({"memry": {"m": 1}, "reward": "-m"}, ["memry"]),
    "data named like a variable": (
        {"data": {"q_dot": {"values": [1], "stepp": 1}}, "reward": "-q_dot"},
        ["data.q_dot.stepp"],
    ),
    "the time step": ({"time_step": "1 parsec", "episode_length": "1d"}, ["time_step"]),
    "a schedule": ({"setpoints": {"a": {"schedule": {"06:00": "x"}}}, "reward": "-a"}, None),
    "a circle": (
        {"expressions": {"a": "b + 1", "b": "c", "c": "a"}, "reward": "-a - b - c"},
        ["expressions.a"],
    ),
    "the FMU's name of a variable": (
        {"variables": {"tau": {}, "w": {"name": 3}}, "reward": "-w"},
        ["variables.w.name"],
    ),
    "an expression of another one": (
        {"expressions": {"other": "1 +"}, "reward": "-other"},
        ["expressions.other"],
    ),
    "a set point": ({"setpoints": {"s": "a"}, "reward": "-s"}, ["setpoints.s"]),
    "a term of the reward": (
        {"reward": {"a": "1 +"}, "kpis": {"k": "a"}},
        ["reward.a"],
    ),
    "a set point of something": (
        {
            "setpoints": {"goal": {"value": 0, "of": "qq"}},
            "agent": {"actions": "tau", "observations": ["q", "goal_error"]},
        },
        ["setpoints.goal.of"],
    ),
}


@pytest.mark.parametrize(("changes", "told"), CONSEQUENCES.values(), ids=CONSEQUENCES)
def test_what_follows_from_a_mistake_is_not_told(changes, told):
    assert mistakes_of(pendulum(**changes)) == (told or ["setpoints.a.schedule.06"])


CURES = {
    "no FMU": (
        ("fmu", "'nix.fmu'"),
        "line 2, fmu: there is no FMU 'nix.fmu' in .* no \\*.fmu; give",
    ),
    "no folder": (("fmu", "'away/nix.fmu'"), "line 2, fmu: .*'nix.fmu'.*does not exist; give"),
    "no number": (
        ("parameters.m", "'heavy'"),
        "line 5, parameters.m: m must be a number, or an expression of constants .* got 'heavy'$",
    ),
    "nearly a constant": (
        ("parameters.m", "'pii'"),
        "parameters.m: .*got 'pii'; did you mean 'pi'",
    ),
    "a name of two things": (
        ("memory.price", "1"),
        "line 6, data.price: the name 'price' is given twice, also at .*line 5, memory.p.*; rename",
    ),
    "a key of two lines": (
        ("time_step", "2"),
        "line 5.*time_step is given there once more: remove",
    ),
    "an action named twice": (
        ("agent.actions", "['tau', 'tau']"),
        "'tau' is named twice; leave one",
    ),
}


@pytest.mark.parametrize(("wrong", "told"), CURES.values(), ids=CURES)
def test_the_key_the_line_and_the_cure_are_told(wrong, told, tmp_path):
    key, value = wrong
    lines = {
        "fmu": '{ bundled = "Pendulum" }',
        "time_step": "0.1",
        "reward": '"-abs(q)"',
    }
    more = {
        "agent.actions": '"tau"',
        "agent.observations": '"q"',
        "variables.tau": "{ levels = [0, 1] }",
    }
    repeated = key == "time_step"
    given = [f"{n} = {value if n == key and not repeated else one}" for n, one in lines.items()]
    given += [f"{key} = {value}"] if key not in {*lines, *more} or repeated else []
    given += ["data.price = { values = [1], step = 1 }"]
    given += [f"{n} = {value if n == key else one}" for n, one in more.items()]
    file = tmp_path / "wrong.toml"
    file.write_text("\n".join(["", *given, ""]))
    with pytest.raises(fmugym.ConfigError, match=told):
        fmugym.load(file)
