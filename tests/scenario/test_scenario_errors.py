"""A scenario that is wrong: one clear line that names field, value, range and unit."""

import pytest
from marks import readable_id
from mutants import killed_by
from seams import replace_seam

from diffabs.scenario.scenario import ScenarioError, load, names

pytestmark = pytest.mark.usefixtures("any_step_is_stable")


def message(path, *overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load(path, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# Bad input: the parts of the message that a person needs


BAD = [
    ("plnt.mass=1", "plnt is not a section", "did you mean plant?"),
    ("plant.mas=1", "plant.mas is not a field of quarter-car", "did you mean mass?"),
    ("plant.type=quarter-cart", 'plant.type = "quarter-cart" is unknown', "did you mean quarter-car?", "lab-rig"),
    ("plant=cart", 'plant.type = "cart" is unknown', "; a part of a module of your own needs --parts MODULE"),
    (
        "tune.free={'plant.mas'=[5,6]}",
        "did you mean plant.mass? There is plant.mass, plant.radius, plant.inertia, plant.crawl_speed, "
        "plant.crawl_speed_kmh",
    ),
    ("plant.mass=1979-05-27", "plant.mass = 1979-05-27 is a date or time; a number in (0, inf) kg is needed"),
    ("road=snw", "road.type", '"snw"', "did you mean snow?"),
    ("road.c9=1", "road.c9 is not a field", "there is slip, mu"),
    ("controller=sampled", "controller.controller is missing: sampled encloses another controller"),
    ("controller={type='sampled',controller={kp=3}}", "controller.controller is missing"),
    ("road=scaled", "road.road is missing: scaled encloses another road"),
    ("controller.antiwindup=clamp", "controller.antiwindup.type", "did you mean clamping?"),
    ("controller.type=clamping", "controller.type", "unknown", "pid"),
    ("controller.type=3", "controller.type = 3 is a number", "pid"),
    ("plant.mass=-1", "plant.mass = -1 is outside (0, inf) kg"),
    ("plant.mass=0", "plant.mass = 0 is outside (0, inf) kg"),
    ("plant.mass=nan", "plant.mass = nan is outside (0, inf) kg"),
    ("plant.mass=inf", "plant.mass = inf is outside (0, inf) kg"),
    ("plant.mass=1" + "0" * 400, 'override "plant.mass=1000', "is a whole number outside [-2^63, 2^63)"),
    ("plant.mass=heavy", 'plant.mass = "heavy" is text', "a number in (0, inf) kg is needed"),
    ("plant.mass=true", "plant.mass = true is a boolean", "a number in (0, inf) kg is needed"),
    ("plant.mass=1,2", "plant.mass = [1, 2] is a list", "a number in (0, inf) kg is needed"),
    ("plant.mass={a=1}", "plant.mass = {'a': 1} is a table", "(0, inf) kg"),
    ("plant.mass=1979-05-27", "plant.mass", "a date or time", "(0, inf) kg"),
    ("plant.mass=", 'plant.mass = "" is text'),
    ("plant.mass.x=1", "plant.mass", "number"),
    ("plant=3", "plant = 3 is a number", "quarter-car"),
    ("reference.slip=1.5", "reference.slip = 1.5 is outside (0, 1]"),
    ("road.mu=0.5", "road.mu = 0.5 is a number", "a list of numbers in [0, inf) is needed"),
    ("road.mu=['a','b']", 'road.mu.0 = "a" is text', "a number in [0, inf)"),
    ("road.mu=[0,[1]]", "road.mu.1 = [1] is a list"),
    ("road.mu=" + ",".join(["-1.23456789e-10"] * 8), "road.mu = [-1.2346e-10", "is outside [0, inf)"),
    ("road.mu=0,0.5,0.9", "road.slip and mu have shapes (17,) and (3,)"),
    ("road={type='burckhardt',c1=-2}", "road.c1 = -2 is outside [0, inf)"),
    ("road={type='patches',roads=['snow','ice'],edges=[1,2]}", "road.edges has shape (2,); 2 roads need (1,)"),
    ("road={type='patches',roads='snow'}", 'road.roads = "snow" is text', "a list of parts"),
    ("road={type='patches',roads=[{c1=2}]}", "road.roads.0.type is missing", "snow"),
    ("road={type='patches',roads={5={c1=2}}}", "road.roads.5 is not there", "0, 1"),
    ("road={type='scaled',road={type='scaled',road='ice',scale=11}}", "road.road.scale = 11 is outside (0, 10]"),
    ("controller={type='state-feedback',high=-inf}", "controller.high = -inf is outside (-inf, inf) N m"),
    ("controller={type='proportional-feedback',low=inf}", "controller.low = inf is outside (-inf, inf)"),
    ("controller={type='scheduled-feedback',high=-inf}", "controller.high = -inf is outside (-inf, inf)"),
    ("actuator={type='limits',low=inf}", "actuator.low = inf is outside (-inf, inf) N m"),
    ("actuator={type='limits',high=-inf}", "actuator.high = -inf is outside (-inf, inf) N m"),
    ("controller={type='pid',low=inf}", "controller.low = inf is outside (-inf, inf) N m"),
    ("controller={type='sliding-mode',high=-inf}", "controller.high = -inf is outside (-inf, inf) N m"),
    ("initial.speed_kmh=-5", "initial.speed_kmh = -5 is outside (0, 720] km/h"),
    ("initial.speed_kmh=fast", 'initial.speed_kmh = "fast" is text', "(0, 720] km/h"),
    ("initial.slip_kmh=5", "initial.slip_kmh is not a field of brake-start"),
    ("initial.speed=0.01", "initial.speed = 0.01 m/s is not above stop.speed = 0.05 m/s"),
    ("initial={speed=9.0,speed_kmh=9.0}", "initial.speed is given twice", "m/s", "km/h"),
    ("stop.speed=-1", "stop.speed = -1 is outside (0, inf) m/s"),
    ("solver.stp=1", "solver.stp is not a field of adaptive", "did you mean step?"),
    ("solver=rk4", 'solver.type = "rk4" is unknown', "there is fixed, adaptive"),
    (
        "solver={type='fixed', rtol=1e-5}",
        "solver.rtol is not a field of fixed",
        "step, duration, every, follow_slides, seed, kinks",
    ),
    ("solver={type='adaptive', rtol=0.1}", "solver.rtol = 0.1 is outside [1e-12, 0.01]"),
    ("solver={type='adaptive', kinks=true}", "solver.kinks is not a field of adaptive"),
    ("solver.step=0", "solver.step = 0 is outside (0, inf) s"),
    ("solver.step=nan", "solver.step = nan is outside (0, inf) s"),
    ("solver.duration=inf", "solver.duration = inf is outside (0, inf) s"),
    ("solver.step=small", 'solver.step = "small" is text', "(0, inf) s"),
    ("solver.every=0", "solver.every = 0 is outside [1, 100000000]"),
    ("solver.every=1.5", "solver.every = 1.5 is a number", "a whole number in [1, 100000000]"),
    ("solver.seed=-1", "solver.seed = -1 is outside [0, 4294967295]"),
    ("solver.step=20", "solver.step = 20 s is outside (0, 10] s"),
    ("solver.step=1e-9", "solver.step = 1e-09 s is outside [1e-07, 10] s"),
    (
        "controller={type='sampled',controller='pid',period=0.0015}",
        "controller.period = 0.0015 s is not a multiple",
        "solver.step = 0.001 s",
    ),
    ("actuator={type='delay',time=5.0}", "actuator.time = 5 s is outside [0.001, 1.022] s"),
    ("actuator={type='delay',capacity=0}", "actuator.capacity = 0 is outside [1, 10000000]"),
    ("actuator={type='delay',capacity=100000000000}", "actuator.capacity", "outside [1, 10000000]"),
    ("actuator={type='delay',capacity=9.5}", "actuator.capacity = 9.5 is a number", "a whole number"),
    ("sensor={type='series',blocks=[{type='noise',slip=-1}]}", "sensor.blocks.0.slip = -1 is outside [0, inf)"),
    ("sensor={type='series',blocks=['lag']}", "sensor.blocks.0.type", '"lag" is unknown'),
    ("controller={type='observer-feedback',correction=[1,2]}", ".0 = 1 is a number", "a list of numbers"),
    ("controller={type='observer-feedback',correction=5}", " = 5 is a number", "a list of lists of numbers"),
    (
        "controller={type='observer-feedback',correction=[[1,2],[1]]}",
        "controller.correction = [[1, 2], [1]] has rows of different lengths",
    ),
    ("controller={type='state-feedback',gain=[1]}", "controller.gain has shape (1,); it needs (2,)"),
    ("controller={type='pid',low=100,high=90}", "controller.low = 100 N m exceeds high = 90 N m"),
    (
        "controller={type='sampled',controller='pid',kp=3}",
        "controller.kp is not a field of sampled; did you mean controller.controller.kp?",
    ),
    ("objective.settling_time.band=0", "objective.settling_time.share and band are both 0"),
    ("objective.settling_tim.band=1", "objective.settling_tim.type is missing", "did you mean settling-time?"),
    ("objective.cost={type='quadratic-cost',q=[1]}", "objective.cost.q has shape (1,); it needs (2,)"),
    ("objective=iae", 'objective = "iae" is text', "a table"),
    ("design=3", "design = 3 is a number", "a table of Q, R, decay, damping, over"),
    ("design.dekay=1", "design.dekay is not a field of design", "did you mean decay?"),
    ("design.Q=1,2", "design.R is missing", "design.Q"),
    ("design={Q=[-1.0,2.0],R=1}", "design.Q is not positive semidefinite", "eigenvalue is -1, outside [0, inf)"),
    ("design={Q=[[1,2],[2,1]],R=1}", "design.Q is not positive semidefinite", "-1, outside [0, inf)"),
    ("design={Q=[[1,2],[0,1]],R=1}", "design.Q = [[1.0, 2.0], [0.0, 1.0]] is not symmetric"),
    ("design={Q=[[1,2],[2]],R=1}", "design.Q = [[1, 2], [2]] is not square", "2 rows"),
    ("design={Q=[1,nan],R=1}", "design.Q = [[1.0, 0.0], [0.0, nan]]", "not finite"),
    ("design={Q=[],R=1}", "design.Q = [] is empty"),
    ("design={Q='x',R=1}", 'design.Q = "x" is text', "a number, a diagonal or a matrix"),
    ("design={Q=[1,'x'],R=1}", 'design.Q.1 = "x" is text'),
    ("design={Q=[1,1],R=0}", "design.R is not positive definite", "0, outside (0, inf)"),
    ("design.decay=-1", "design.decay = -1 is outside [0, inf) 1/s"),
    ("design.damping=1", "design.damping = 1 is outside [0, 1)"),
    ("design.damping=nan", "design.damping = nan is outside [0, 1)"),
    ("design.over=3", "design.over = 3 is a number", "a table of ranges"),
    (
        "design.over.plant.mas=1,2",
        "design.over.plant.mas is not a parameter of this loop's linear model",
        "did you mean plant.mass?",
    ),
    (
        "design.over.controller.kp=1,2",
        "design.over.controller.kp is not a parameter of this loop's linear model",
        "plant.mass",
    ),
    ("design.over.plant.mass=5", "design.over.plant.mass = 5 is a number", "a range { low, high } in (0, inf) kg"),
    ("design.over.plant.mass=[]", "design.over.plant.mass = [] is not a range { low, high } in (0, inf) kg"),
    ("design.over.plant.mass=['a',1]", 'design.over.plant.mass.low = "a" is text', "(0, inf) kg"),
    ("design.over.plant.mass=6:5", "design.over.plant.mass = [6.0, 5.0] is inverted", "(0, inf) kg"),
    (
        "design.over.plant.mass=5:6:7",
        'design.over.plant.mass = "5:6:7" is text',
        "a range { low, high } in (0, inf) kg",
    ),
    ("design.over.plant.mass=a:6", 'design.over.plant.mass = "a:6" is text', "a range { low, high } in (0, inf) kg"),
    ("design.over={'plant.mass'={low=5,type='normal'}}", "a range { low, high } in (0, inf) kg is needed"),
    ("tune.over.plant.mass=5:6", "tune.over.plant.mass is an interval; a list [5, ...] is needed"),
    ("tune.over={'plant.mass'={low=5,high=6}}", "tune.over.plant.mass is an interval; a list [5, ...] is needed"),
    (
        "sweep.over.plant.mass=5.3,6.2",
        "sweep.over.plant.mass = [5.3, 6.2] is a list; an interval is { low = 5.3, high = 6.2 }, a choice of values"
        ' { type = "categorical", choices = [5.3, 6.2] }',
    ),
    ("sweep.over.plant.mass=[]", "sweep.over.plant.mass = [] is a list; an interval is"),
    ("sweep.over.plant.mass=6:5", "low = 6 is not below high = 5"),
    (
        "sweep.over.plant.mass=5",
        "plant.mass = 5 is a number; an interval { low, high } or a table",
    ),
    ("design.over.plant.mass=6,5", "design.over.plant.mass = [6.0, 5.0] is inverted", "(0, inf) kg"),
    ("design.over.plant.mass=0,5", "design.over.plant.mass = [0.0, 5.0] is outside (0, inf) kg"),
    ("design.over.plant.mass=nan,5", "design.over.plant.mass = [nan, 5.0] is outside (0, inf) kg"),
    ("design.over.plant.mass=5,inf", "design.over.plant.mass = [5.0, inf] is outside (0, inf) kg"),
    ("design.over.plant.road.mu=0,1", "design.over.road.mu is a list of 17 numbers; only single numbers"),
    ("design.over.initial.speed_kmh=5,900", "design.over.initial.speed_kmh = [5.0, 900.0] is outside (0, 720] km/h"),
    ("design.over={'plant.mass'=[5,6],plant={mass=[5,6]}}", "design.over.plant.mass is given twice"),
    ("design.over={'initial.speed'=[1,2],'initial.speed_kmh'=[1,2]}", "is given twice, in m/s and in km/h"),
    ("design.over=" + "{a=" * 20 + "1" + "}" * 20, "design.over", "nested more than 16 deep"),
    ("tune=3", "tune = 3 is a number", "a table of starts, seed, iterations, samples, decay, damping, clauses, free"),
    ("tune.start=2", "tune.start is not a field of tune", "did you mean starts?"),
    ("tune.starts=0", "tune.starts = 0 is outside [1, 1000]"),
    ("tune.starts=1.5", "tune.starts = 1.5 is a number", "a whole number in [1, 1000]"),
    ("tune.iterations=0", "tune.iterations = 0 is outside [1, 100000]"),
    ("tune.samples=-1", "tune.samples = -1 is outside [0, 100000]"),
    ("tune.decay=-1", "tune.decay = -1 is outside [0, inf) 1/s"),
    ("tune.decay=nan", "tune.decay = nan is outside [0, inf) 1/s"),
    ("tune.damping=1", "tune.damping = 1 is outside [0, 1)"),
    ("tune.free=kp", 'tune.free = "kp" is text', "a table of ranges"),
    ("tune.free.controller.kq=1,2", "tune.free.controller.kq is not a parameter of this loop", "mean controller.kp?"),
    (
        "tune.free.controller.kp=5",
        "tune.free.controller.kp = 5 is a number",
        'a range { low, high } in (-inf, inf) N m, or "d',
    ),
    ("tune.free.controller.kp=decl", 'tune.free.controller.kp = "decl" is text', '"declared"'),
    (
        "tune.free.controller.kp=1,2,3",
        "kp = [1, 2, 3] is not a range { low, high } in (-inf, inf) N m",
    ),
    ("tune.free.controller.kp=['a',1]", 'tune.free.controller.kp.low = "a" is text', "(-inf, inf) N m"),
    ("tune.free.controller.kp=6,5", "tune.free.controller.kp = [6.0, 5.0] is empty", "(-inf, inf) N m"),
    ("tune.free.controller.cutoff=-1,5", "tune.free.controller.cutoff = [-1.0, 5.0] is outside (0, inf) rad/s"),
    ("tune.free.controller.kp=nan,5", "tune.free.controller.kp = [nan, 5.0] is outside (-inf, inf) N m"),
    ("tune.free.road.mu=[[0,1],2]", "tune.free.road.mu.low = [0, 1] has 2 numbers; the parameter has 17"),
    ("tune.free.initial.speed_kmh=5,900", "tune.free.initial.speed_kmh = [5.0, 900.0] is outside (0, 720] km/h"),
    ("tune.free={'plant.mass'=[5,6],plant={mass=[5,6]}}", "tune.free.plant.mass is given twice"),
    ("tune.over={'initial.speed'=[1],'initial.speed_kmh'=[2]}", "tune.over.initial.speed is given twice, in m/s and"),
    ("tune.over.plant.mass=heavy", 'tune.over.plant.mass.0 = "heavy" is text', "(0, inf) kg"),
    ("tune.over.plant.mass=5,-1", "tune.over.plant.mass.1 = -1 is outside (0, inf) kg"),
    ("tune.over.plant.mass=[]", "tune.over.plant.mass = [] is empty", "(0, inf) kg"),
    ("tune.over.road.mu=0,1", "tune.over.road.mu is a list of 17 numbers; only single numbers can differ"),
    ("tune.over.plant.mas=1,2", "tune.over.plant.mas is not a parameter of this loop", "did you mean plant.mass?"),
    ("tune.over.initial.speed_kmh=5,900", "tune.over.initial.speed_kmh.1 = 900 is outside (0, 720] km/h"),
    ("tune.objective=iae", 'tune.objective = "iae" is text', "a table of weights"),
    ("tune.objective.ia=1", "tune.objective.ia is not a metric of this scenario; did you mean iae?"),
    ("tune.objective.iae=inf", "tune.objective.iae = inf is outside (-inf, inf)"),
    ("tune.objective.iae=much", 'tune.objective.iae = "much" is text'),
    ("tune.limits.stop_time=nan", "tune.limits.stop_time = nan is outside (-inf, inf) s"),
    ("tune.limits.max_slp=1", "tune.limits.max_slp is not a metric of this scenario; did you mean max_slip?"),
    ("tune.aggregate=3", "tune.aggregate = 3 is a number", "mean, smooth-worst, cvar, quantile"),
    ("tune.aggregate=cvr", 'tune.aggregate.type = "cvr" is unknown', "did you mean cvar?"),
    ("tune.aggregate={type=3}", "tune.aggregate.type = 3 is a number", "one of mean"),
    ("tune.aggregate={type='cvar',softness=1}", "tune.aggregate.softness is not a field of cvar", "there is level"),
    ("tune.aggregate={type='cvar',level=1}", "tune.aggregate.level = 1 is outside [0, 1)"),
    ("title=3", "title = 3 is a number", "text"),
    ('title="a\\nb"', 'title = "a\\nb" is outside one line of printable characters'),
    ('title="a\\u001b[2J"', "is outside one line of printable characters"),
    ('title="\\u202eright to left"', "is outside one line of printable characters"),
    ('description="a\\u0007"', "description", "is outside lines of printable characters"),
    ('objective={"a\\nb"={type="iae"}}', "a name in objective", "is outside one line of printable characters"),
    ("nonsense", '"nonsense" is not of the form section.field=value'),
    ("a..b=1", "is not of the form section.field=value"),
    ("=1", "is not of the form section.field=value"),
    ("plant.mass=1\nname=2", "plant.mass", "is text"),
    ("plant.'\x1b[31m\n'=1", "is not a field of quarter-car"),
    ("plant.mass=" + "x" * 500, "..."),
]


@killed_by("scenario.registry", "'lists of ' * (depth - 1)", "''")
@killed_by(
    "scenario.parameter_paths",
    "        if not (np.all(low < high) or (not or_else and np.all(low <= high))):",
    "        if False:",
)
@killed_by(
    "scenario.parameter_paths",
    "        if not (allowed.holds(low) and allowed.holds(high)):",
    "        if False:",
)
@pytest.mark.parametrize("case", BAD, ids=lambda case: readable_id(case[0]))
def test_a_bad_value_is_refused_in_one_line(file, case):
    override, *needed = case
    line = message(file(""), override)
    for text in needed:
        assert text in line
    assert "plant.road" not in line
    assert len(line) < 600
    assert line.isprintable()


def test_every_value_out_of_range_is_named():
    line = message("slip-lmi", "plant.mass=-1", "reference.slip=2")
    assert "plant.mass = -1 is outside (0, inf) kg" in line
    assert "reference.slip = 2 is outside (0, 1]" in line


def test_road_given_twice(file):
    assert "road is given twice" in message(file('road = "snow"\n[plant]\nroad = "ice"'))


def test_nesting_without_end(file):
    nested = "road" + ".road" * 30 + '.type="scaled"'
    types = [f'road{".road" * i}.type="scaled"' for i in range(30)]
    assert "nested more than 16 deep" in message(file("\n".join([*types, nested])))
    assert "nested too deeply" in message(file("a = " + "[" * 5000))


# Bad files


def test_missing_file_and_unknown_name(tmp_path):
    assert "No such file" in message(tmp_path / "none.toml")
    line = message("slip-lim")
    assert "did you mean slip-lmi?" in line
    assert "lab-rig" in line


def test_directory(tmp_path):
    assert "Is a directory" in message(tmp_path)


def test_not_text(tmp_path):
    path = tmp_path / "binary.toml"
    path.write_bytes(b"title = 'x'\nname = '\xff\xfe'\n")
    assert "is not UTF-8 text (at line 2)" in message(path)
    path.write_bytes(b"\xef\xbb\xbftitle = 'x'\n\xff")
    assert "is not UTF-8 text (at line 2)" in message(path)


@pytest.mark.parametrize("text", ["title = 'x'\n[plant\n", "title = 'x'\nmass = 1 kg\n", "a = 1\na = 2\n"])
def test_not_toml_gives_the_line(file, text):
    line = message(file(text))
    assert "mine.toml" in line
    assert "is not TOML" in line
    assert "line 2" in line


def test_endless_file():
    assert "not a regular file" in message("/dev/zero")


def test_large_file(file):
    assert "larger than 1000000 bytes" in message(file("#" * 1_000_001))


def test_nothing_is_evaluated(file):
    assert '"__import__(' in message(file("plant.mass = \"__import__('os').abort()\""))


# The step


@pytest.fixture
def checked_step(monkeypatch):
    from diffabs.loop.stability import stable_step

    replace_seam(monkeypatch, "stable_step", stable_step)


def test_unstable_step(checked_step):
    line = message("slip-estimator", "controller.kp=10000")
    assert "solver.step = 0.0001 s is not stable" in line
    largest = float(line.partition("(0, ")[2].partition("]")[0])
    load("slip-estimator", ["controller.kp=10000", f"solver.step={largest}"])
    assert "is not stable" in message("slip-estimator", "controller.kp=10000", f"solver.step={1.02 * largest}")


@pytest.mark.slow
@pytest.mark.parametrize("name", names())
def test_packaged_step_is_stable(checked_step, name):
    load(name)


def test_a_sampling_period_cannot_be_tuned():
    """The command line can say so before anything is compiled."""
    line = message("slip-cured", "tune.free.controller.period=1e-3,2e-3")
    assert line == "tune.free.controller.period cannot be tuned: a run does not depend smoothly on it"


def test_too_many_combinations(file):
    values = ",".join(map(str, range(1, 401)))
    changes = (f"tune.over.plant.mass={values}", f"tune.over.plant.inertia={values}")
    assert "tune.over has 160000 combinations, outside [1, 100000]; set tune.samples" in message(file(""), *changes)
    load(file(""), [*changes, "tune.samples=5"])


def test_a_start_that_overflows_is_refused_in_a_line():
    with pytest.raises(ScenarioError, match="initial is at the stop or beyond"):
        load("arm-balance", ["initial.theta=1e300"])


@killed_by("scenario.section_sweep", "lines := describe_missing_inner_parts(family, item,", "lines := () and (item,")
@killed_by("scenario.registry", "and type_name(inner) is None:", "and inner is None:")
@pytest.mark.parametrize(
    "choice", ['"sampled"', "{type='sampled', period=1e-3}", "{type='sampled', controller={kp=1}}"]
)
def test_a_choice_of_a_sweep_names_the_part_inside(choice):
    """Without it half of the runs would have the default controller."""
    line = message("slip-lmi", f"sweep.over.controller=['state-feedback', {choice}]")
    assert line == ("sweep.over.controller.1.controller is missing: sampled encloses another controller; give its type")
    inside = "{type='sampled', controller='state-feedback'}"
    assert set(load("slip-lmi", [f"sweep.over.controller=['pid', {inside}]"]).sweep.over["controller"].parts) == {
        "pid",
        "1",
    }


@killed_by("scenario.registry", "lines += describe_missing_inner_parts(inner_family, inner, where)", "0", case="scaled")
@killed_by(
    "scenario.registry",
    "describe_missing_inner_parts(inner_family, item,",
    "() and (inner_family, item,",
    case="patches",
)
@pytest.mark.parametrize(
    ("choice", "place"),
    [
        ("{{type='scaled', scale=0.5, road='{}'}}", "1.road.road"),
        ("{{type='patches', roads=['snow', '{}']}}", "1.roads.1.road"),
    ],
    ids=["scaled", "patches"],
)
def test_a_choice_names_the_parts_at_every_depth(choice, place):
    line = message("slip-lmi", f"sweep.over.road=['rig', {choice.format('scaled')}]")
    assert line == f"sweep.over.road.{place} is missing: scaled encloses another road; give its type"
    load("slip-lmi", ["sweep.over={}", f"sweep.over.road=['rig', {choice.format('ice')}]"])


def test_a_grid_of_what_does_not_vary():
    line = message("slip-lmi", "sweep.design={type='grid', levels={initial.sped=3}}")
    assert "sweep.design.levels.initial.sped is not varied in sweep.over; did you mean initial.speed?" in line
    twice = "sweep.design={type='grid', levels={'initial.speed'=3, 'initial.speed_kmh'=3}}"
    assert message("slip-lmi", twice) == "sweep.design.levels.initial.speed is given twice, in m/s and in km/h"
    line = message("slip-lmi", "sweep.design={type='grid', levels={road.w4_kmh=3}}")
    assert "sweep.design.levels.road.w4_kmh is not varied" in line  # w4 is no speed
