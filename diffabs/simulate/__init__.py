"""Run a loop: Runge-Kutta steps, landing on the stop, one run or many, the largest stable step, attraction."""
