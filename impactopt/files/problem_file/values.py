"""Base class of a problem file's sections, types of their values, and sections made from dataclasses.

Validators raise ValueError, which pydantic collects, with the value and the fix in the message. Their
docstrings are the descriptions of the values in the reference.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, ClassVar, Literal, Union, cast, get_args, get_origin, get_type_hints

import casadi as ca
import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    create_model,
    model_validator,
)

from impactopt.contact.fields import About, abouts
from impactopt.errors import check_choice, did_you_mean
from impactopt.problem.checks import MOST_FREEZES, MOST_TOUCHES
from impactopt.robots.presets import robot_names
from impactopt.solvers.ipopt import IPOPT_DEFAULTS

# IPOPT options that a problem file may set. A problem file is data, which must not make IPOPT load a library,
# or read or write a file. This is a list of safe options, not of unsafe ones: a new IPOPT may add some of
# those, and each option also exists with prefixes ("resto.hsllib"). Left out are options that load HSL or
# Pardiso from wherever the loader finds them, or write files: linear_solver, linear_system_scaling,
# nlp_scaling_method, dependency_detector, and the options of those solvers.
_NAMES = """
tol s_max max_iter max_wall_time max_cpu_time dual_inf_tol constr_viol_tol compl_inf_tol acceptable_tol
acceptable_iter acceptable_dual_inf_tol acceptable_constr_viol_tol acceptable_compl_inf_tol
acceptable_obj_change_tol diverging_iterates_tol mu_target

print_level print_timing_statistics print_info_string inf_pr_output print_frequency_iter print_frequency_time
sb

nlp_lower_bound_inf nlp_upper_bound_inf fixed_variable_treatment kappa_d bound_relax_factor
honor_original_bounds check_derivatives_for_naninf grad_f_constant jac_c_constant jac_d_constant
hessian_constant

obj_scaling_factor

bound_push bound_frac slack_bound_push slack_bound_frac constr_mult_init_max bound_mult_init_val
bound_mult_init_method least_square_init_primal least_square_init_duals

warm_start_init_point warm_start_same_structure warm_start_bound_push warm_start_bound_frac
warm_start_slack_bound_push warm_start_slack_bound_frac warm_start_mult_bound_push warm_start_mult_init_max
warm_start_entire_iterate warm_start_target_mu

mu_max_fact mu_max mu_min adaptive_mu_globalization adaptive_mu_kkterror_red_iters
adaptive_mu_kkterror_red_fact filter_margin_fact filter_max_margin adaptive_mu_monotone_init_factor
adaptive_mu_kkt_norm_type mu_strategy mu_oracle fixed_mu_oracle mu_init barrier_tol_factor
mu_linear_decrease_factor mu_superlinear_decrease_power tau_min sigma_max sigma_min quality_function_norm_type
quality_function_centrality quality_function_balancing_term quality_function_max_section_steps
quality_function_section_sigma_tol quality_function_section_qf_tol

line_search_method alpha_red_factor accept_every_trial_step accept_after_max_steps alpha_for_y alpha_for_y_tol
tiny_step_tol tiny_step_y_tol watchdog_shortened_iter_trigger watchdog_trial_iter_max theta_max_fact
theta_min_fact eta_phi delta s_phi s_theta gamma_phi gamma_theta alpha_min_frac max_soc kappa_soc obj_max_inc
max_filter_resets filter_reset_trigger corrector_type skip_corr_if_neg_curv skip_corr_in_monotone_mode
corrector_compl_avrg_red_fact soc_method nu_init nu_inc rho kappa_sigma recalc_y recalc_y_feas_tol slack_move

mehrotra_algorithm fast_step_computation min_refinement_steps max_refinement_steps residual_ratio_max
residual_ratio_singular residual_improvement_factor neg_curv_test_tol neg_curv_test_reg
max_hessian_perturbation min_hessian_perturbation perturb_inc_fact_first perturb_inc_fact perturb_dec_fact
first_hessian_perturbation jacobian_regularization_value jacobian_regularization_exponent perturb_always_cd

expect_infeasible_problem expect_infeasible_problem_ctol expect_infeasible_problem_ytol start_with_resto
soft_resto_pderror_reduction_factor max_soft_resto_iters required_infeasibility_reduction max_resto_iter
evaluate_orig_obj_at_resto_trial resto_penalty_parameter resto_proximity_weight bound_mult_reset_threshold
constr_mult_reset_threshold resto_failure_feasibility_threshold

limited_memory_aug_solver limited_memory_max_history limited_memory_update_type limited_memory_initialization
limited_memory_init_val limited_memory_init_val_max limited_memory_init_val_min limited_memory_max_skipping
limited_memory_special_for_resto hessian_approximation hessian_approximation_space

mumps_print_level mumps_pivtol mumps_pivtolmax mumps_mem_percent mumps_permuting_scaling mumps_pivot_order
mumps_scaling mumps_dep_tol
"""
ALLOWED = frozenset(_NAMES.split())


def _known_robot(name: str) -> str:
    """A preset's name."""
    check_choice("there is no robot", name, robot_names())
    return name


def _duration(value: Any) -> list[float]:
    """A number > 0, or [shortest, longest]."""
    pair = value if isinstance(value, list) else [value, value]
    if len(pair) != 2 or not all(_is_number(x) and 0 < x < np.inf for x in pair):
        raise ValueError(f"{value}; give a number > 0 [s], or [shortest, longest]")
    return _ascending([float(x) for x in pair])


def _contact_duration(value: Any) -> list[float]:
    """A number > 0, or [shortest, longest], of which the shortest may be 0."""
    if isinstance(value, list) and len(value) == 2 and _is_number(value[0]) and value[0] == 0:
        return [0.0, _duration([value[1], value[1]])[1]]
    return _duration(value)


def _factor(value: Any) -> Any:
    """A number > 0, or [least, largest]."""
    pair = value if isinstance(value, list) else [value, value]
    if len(pair) != 2 or not all(_is_number(x) and 0 < x < np.inf for x in pair):
        raise ValueError(f"{value}; give a number > 0, or [least, largest] for the plan to choose")
    if pair is value and not pair[0] < pair[1]:
        raise ValueError(f"{value}; the first of two has to be less than the second")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _fractions(value: list[float]) -> list[float]:
    """Numbers > 0 that sum to 1."""
    if abs(sum(value) - 1) > 1e-9:
        raise ValueError(f"{value} sum to {sum(value):g}; give fractions that sum to 1")
    return value


def _ascending(value: list[float]) -> list[float]:
    """[lower, upper]."""
    if not value[0] <= value[1]:
        raise ValueError(f"{value}; the first must not exceed the second")
    return value


def unit_vector(value: list[float]) -> list[float]:
    """A unit vector."""
    length = float(np.linalg.norm(value))
    if abs(length - 1) > 1e-6:
        meant = f"; did you mean {np.round(np.array(value) / length, 6).tolist()}?" if length else ""
        raise ValueError(f"{value} has the length {length:.6g}; give a unit vector{meant}")
    return value


def per_joint(value: Any) -> Any:
    """A number >= 0, or a table."""
    numbers = value.values() if isinstance(value, dict) else [value]
    if not all(_is_number(x) and 0 <= x < np.inf for x in numbers):
        raise ValueError(f"{value}; give a number >= 0, or a table of such numbers by joint")
    return value


def _joint_names(value: list[str]) -> list[str]:
    """Names, at least one."""
    if not value:
        raise ValueError("it is empty; name a joint, or give a pattern")
    return value


def _hand_names(value: list[str]) -> list[str]:
    """Names, each once."""
    if len(set(value)) != len(value):
        raise ValueError(f"{value}; give each name once")
    return value


def _posture(value: Any) -> Any:
    """A name, or a list of numbers."""
    if not (isinstance(value, str) or (value and _numbers(value))):
        raise ValueError(f"{value!r}; give the name of a posture, or a configuration: a list of numbers")
    return value


def any_margin(value: Any) -> float | None:
    """A number >= 0, or "anywhere"."""
    if value == "anywhere":
        return None
    if not _is_number(value) or not 0 <= value < np.inf:
        raise ValueError(f'{value!r}; give a number >= 0, or "anywhere"')
    return float(value)


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and all(_is_number(x) and np.isfinite(x) for x in value)


def _three(value: Any) -> bool:
    return _numbers(value) and len(value) == 3


def _matrix(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_three, value))


def _rotation(value: Any) -> Any:
    """Three rows of three numbers."""
    if not _matrix(value) or not (
        np.allclose(np.array(value) @ np.transpose(value), np.eye(3), rtol=0, atol=1e-6)
        and np.linalg.det(value) > 0
    ):
        raise ValueError(f"{value}; give a rotation matrix: three rows of three numbers")
    return value


def _inertia(value: Any) -> Any:
    """Three numbers, or three rows of three."""
    if not (_three(value) or _matrix(value)):
        raise ValueError(f"{value}; give three numbers, or three rows of three numbers")
    return value


def _ipopt_options(options: dict[str, Any]) -> dict[str, Any]:
    """A table."""
    # each value is checked by IPOPT itself, with a program of one variable
    if len(options) > len(ALLOWED):
        raise ValueError(f"has {len(options)} keys; there are {len(ALLOWED)} to give")
    x, wrong = ca.MX.sym("x"), []
    for name, value in options.items():
        if name not in ALLOWED:
            near = did_you_mean(name, ALLOWED)
            wrong.append(
                f"{name} is not among the options of IPOPT that problem files set: those with which it loads "
                f"no library and writes no file{near}"
            )
            continue
        if not isinstance(value, (bool, int, float, str)):
            wrong.append(f"{name} = {value!r}; give a number or text")
            continue
        trial = {**IPOPT_DEFAULTS, "print_level": 0, name: value}
        try:
            ca.nlpsol("trial", "ipopt", {"x": x, "f": x**2}, {"ipopt": trial})
        except (RuntimeError, NotImplementedError):
            wrong.append(f"IPOPT refuses {name} = {value!r}")
    if wrong:
        raise ValueError("; ".join(wrong))
    return options


Positive = Annotated[float, Field(gt=0)]
Freezes = Annotated[int, Field(ge=0, le=MOST_FREEZES)]


def touches_or_order(value: Any) -> Any:
    """A whole number from 1 to 4, or a list of names."""
    if isinstance(value, list) and value and all(isinstance(name, str) for name in value):
        return tuple(value)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MOST_TOUCHES:
        raise ValueError(f"give a whole number from 1 to {MOST_TOUCHES}, or a list of names")
    return value


Touches = Annotated[Any, PlainValidator(touches_or_order)]
NotNegative = Annotated[float, Field(ge=0)]
AtLeastOne = Annotated[float, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, le=1)]
Restitution = Annotated[float, Field(ge=0, le=1)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Point2 = Annotated[list[float], Field(min_length=2, max_length=2)]
UnitVector = Annotated[Vector, AfterValidator(unit_vector)]
Bound = Annotated[float, Field(allow_inf_nan=True)]  # inf: none
Range = Annotated[list[Bound], Field(min_length=2, max_length=2), AfterValidator(_ascending)]
Margin = Annotated[Any, PlainValidator(any_margin)]
Posture = Annotated[Any, PlainValidator(_posture)]
Rotation = Annotated[Any, PlainValidator(_rotation)]
Inertia = Annotated[Any, PlainValidator(_inertia)]
Factor = Annotated[Any, PlainValidator(_factor)]
Duration = Annotated[Any, PlainValidator(_duration)]
ContactDuration = Annotated[Any, PlainValidator(_contact_duration)]
Fractions = Annotated[list[Positive], AfterValidator(_fractions)]
PerJoint = Annotated[Any, PlainValidator(per_joint)]
Preset = Annotated[str, AfterValidator(_known_robot)]
JointNames = Annotated[list[str], AfterValidator(_joint_names)]
HandNames = Annotated[list[str], AfterValidator(_hand_names)]
Pair = Annotated[list[str], Field(min_length=2, max_length=2)]
IpoptOptions = Annotated[dict[str, Any], AfterValidator(_ipopt_options)]


def optional(about: str, key: str | None = None) -> Any:
    """An optional key, whose default is that of the class that the section builds.

    about : description, with the unit in brackets.  key : its name in the file, if that has a unit.
    """
    return Field(default=None, alias=key, description=about)


def required(about: str, key: str | None = None) -> Any:
    """A required key; arguments as of `optional`."""
    return Field(alias=key, description=about)


def attribute_docs(kind: type) -> dict[str, str]:
    """Description of each attribute in the docstrings of a class and its bases, on one line; `a, b : text`
    describes both.
    """
    out: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        doc = inspect.cleandoc(each.__doc__ or "")  # Python 3.13 removes the indentation, older ones do not
        section = re.split(r"\nAttributes\n-+\n", doc)[-1]
        entries = re.split(r"\n(?=[a-z_]+(?: \[\w+\])?(?:, [a-z_]+(?: \[\w+\])?)* : )", "\n" + section)
        for entry in entries[1:]:
            names, _, text = entry.partition(" : ")
            for name in names.split(","):
                out[name.split()[0]] = " ".join(text.split()).rstrip(".")
    return out


class Section(BaseModel):
    """Base class of sections; unknown keys, NaN, infinity and text instead of numbers are refused.

    The first sentence of a subclass's docstring describes the section in the reference.

    kind : the class that it builds.  choice : the field that selects the kind of section.
    apart : fields that are sections of another class.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
    kind: ClassVar[Any] = None
    choice: ClassVar[str] = ""
    apart: ClassVar[tuple[str, ...]] = ()

    def given(self) -> dict[str, Any]:
        """Values of the keys in the file, by the names of the class's fields."""
        return self.model_dump(exclude_unset=True, exclude={self.choice, *self.apart})

    def build(self) -> Any:
        """The thing that this section describes."""
        return self.kind(**self.given())

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Default values by field; a field without a default is left out."""
        if not is_dataclass(cls.kind):
            return {}
        made = {f.name: f.default_factory() for f in fields(cls.kind) if f.default_factory is not MISSING}
        return made | {f.name: f.default for f in fields(cls.kind) if f.default is not MISSING}

    @model_validator(mode="after")
    def _can_be_built(self) -> Section:
        if self.kind is not None:
            self.build()
        return self


def section_of(kind: type, base: type[Section] = Section) -> Any:
    """The section of a dataclass: a key for each field with metadata (`about`), the class's docstring."""
    hints = get_type_hints(kind)
    keys: dict[str, Any] = {}
    for field, description in abouts(kind):
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        key = description.key_of(field.name)
        alias = None if key == field.name else key
        make_key = required if needed else optional
        keys[field.name] = (_value(hints[field.name], description), make_key(description.text, alias))
    section = create_model(kind.__name__, __base__=base, __doc__=kind.__doc__, **keys)
    section.kind = kind
    return section


def sections_of(name: str, doc: str, kinds: Mapping[str, type]) -> Any:
    """A section with an optional subsection for each of these classes."""
    parts: dict[str, Any] = {key: (section_of(kind), optional("")) for key, kind in kinds.items()}
    return create_model(name, __base__=Section, __doc__=doc, **parts)


def one_of(words: Iterable[str]) -> Any:
    """Type annotation for one of these words."""
    return Literal[tuple(words)]


def _value(hint: Any, about: About) -> Any:
    """Type annotation of a field for pydantic: its own without None, with its range."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    kind = next(k for k in kinds if k is not type(None))
    if about.by_joint:
        return Annotated[Any, PlainValidator(per_joint)]
    if about.none:
        return Annotated[Any, PlainValidator(any_margin)]
    if about.choices:
        return one_of(about.choices)
    bounds = {"gt": about.above, "ge": about.least, "le": about.most}
    limits: dict[str, Any] = {name: bound for name, bound in bounds.items() if bound is not None}
    if get_args(kind) == (float, ...):
        return list[Annotated[float, Field(**limits)]]
    if get_origin(kind) is tuple:
        size = len(get_args(kind))
        numbers = Annotated[list[float], Field(min_length=size, max_length=size)]
        return Annotated[numbers, AfterValidator(unit_vector)] if about.direction else numbers
    if kind is float:
        return Annotated[float, Field(**limits, allow_inf_nan=True if about.endless else None)]
    return cast(Any, kind)
