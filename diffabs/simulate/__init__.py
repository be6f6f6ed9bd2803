"""Run a loop: Runge-Kutta steps, landing on the stop, one run or many, what must not be run, estimates of errors."""
