"""IPOPT options that a problem file may set, checked by IPOPT itself."""

from __future__ import annotations

from typing import Annotated, Any

import casadi as ca
from pydantic import AfterValidator

from impactopt.errors import did_you_mean
from impactopt.solvers.ipopt import IPOPT_DEFAULTS

# A problem file is data, which must not make IPOPT load a library,
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


IpoptOptions = Annotated[dict[str, Any], AfterValidator(_ipopt_options)]
