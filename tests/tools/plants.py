"""The bundled FMUs as plants: what moves them, what they tell, and where they start."""

PLANTS = {
    "CartPole": ("f", ["x", "x_dot", "theta", "theta_dot"], "theta_0", 10.0),
    "Pendulum": ("tau", ["theta", "theta_dot"], "q_0", 0.1),
    "DoublePendulum": ("tau2", ["q1", "q1_dot", "q2", "q2_dot"], "q1_0", 0.1),
    "House": ("u", ["T_m", "T_w", "T_air"], "T_w_0", 1.0),
}
"""By model: its input, its outputs, a parameter for the start, and a size of inputs."""

ONCE = (("CartPole", "1.0"), ("Pendulum", "3.0"), ("DoublePendulum", "2.0"), ("House", "3.0"))
"""Each bundled model in one version of FMI, and each version, where not all pairs count."""
