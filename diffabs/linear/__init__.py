"""Linear systems in pure JAX: linearisation, sampling, Riccati and Lyapunov equations, LQR and LQG."""
