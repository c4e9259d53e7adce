"""What is right for each of the scripts, and by how much a number may differ from it."""

from experiments.reported import scripts
from experiments.reported.case import Case

CASES = {
    "data": [
        Case("the second record that residuals read from a global: k", scripts.second_record, 3.0, 1e-6),
        Case("the second g that a force reads from a global: v after 1 s", scripts.second_gravity, -1.62, 1e-9),
        Case("a record changed in place: k", scripts.array_changed_in_place, 3.0, 1e-6),
        Case("a run that reaches infinity, without check()", scripts.forgotten_check, "failed"),
    ],
    "Lagrangians": [
        Case("a mass that grows with time: q(1)", scripts.growing_mass, -0.699303, 1e-5),
        Case("a hoisted load: angle after 2 s", scripts.hoisted_load, 0.247029, 1e-5),
        Case("a coordinate without mass", scripts.massless_coordinate, "constraint"),
    ],
    "assembly": [
        Case("three links, 300 guesses: not the nearest, silently", scripts.nearest_assembly, 0.0, is_long=True),
    ],
    "dry friction": [
        Case(
            "a gear of which both sides rub: angle after 1 s", scripts.gear_that_rubs_on_both_sides, 0.725 / 1.5, 1e-4
        ),
        Case("a driven crank that rubs: torque", scripts.driven_crank_that_rubs, 0.4, 1e-9),
        Case("two joints, one of which has a limit of 0: q after 1 s", scripts.joint_without_friction, 0.35, 1e-6),
    ],
    "guards": [
        Case("at rest at its stop, pulled off: q after 1 s", scripts.pulled_off_its_stop, 1.0, 1e-9),
        Case("the same, with a velocity of -1e-17", scripts.rounding_at_its_stop, 1.0, 1e-9),
        Case("a load of 3 N that begins at 0.62 s: q after 1 s", scripts.load_at_a_known_time, 0.2166, 1e-9),
        Case("a constraint that params switch off", scripts.constraint_switched_off, "switch"),
    ],
    "fits": [
        Case("run.q - y of shapes (101, 1) and (101,)", scripts.rank_promotion, "(101, 101)"),
        Case("transforms for one of two parameters: c", scripts.transforms_of_some, 3.0, 1e-6),
        Case("a record with a sample missing", scripts.nan_residuals, "['mast'][17]"),
        Case("10,000 steps of which one number is kept: MB", scripts.outputs_alone, 0.0, 1.0),
        Case("two parameters whose sum alone is seen", scripts.sum_of_two_parameters, "only through their sum"),
        Case("Rosenbrock's valley from (-12, 10): iterations, of 50", scripts.rosenbrock_valley, 0.0, 50.0),
    ],
    "compiler": [
        Case("drag by the largest velocity on a circle: x after 20 steps", scripts.drag_by_the_largest, 0.57010, 1e-5),
        Case("a constant beyond the integers: acceleration", scripts.conversion_out_of_range, 2.147483647, 1e-9),
        Case("a Hessian through Newton - differences", scripts.hessian_with_newton, 0.0, 1e-8),
        Case("a product of Booleans in a force: acceleration", scripts.boolean_product, -1.0, 1e-12),
    ],
    "the rest": [
        Case("a step of a diagonal system over one of rk4, time", scripts.diagonal_system, 1.0, 1.0),
        Case("a small run with a bar over one without, time", scripts.progress_of_a_small_run, 1.0, 4.0),
        Case("a held input that jumps within a step", scripts.jump_within_a_step, "jumps at t = 0.1"),
        Case("a list for q0", scripts.list_for_q0, "`q0` is a list of numbers"),
        Case("a sweep without in_axes", scripts.missing_axes, "`in_axes` must say"),
    ],
}
