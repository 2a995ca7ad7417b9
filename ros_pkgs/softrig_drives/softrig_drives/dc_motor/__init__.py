"""Speed control of a brushed DC motor: sliding mode against PID.

A. Ma'arif and A. Cakan, Simulation and Arduino hardware implementation of DC motor control using sliding mode
controller, Journal of Robotics and Control 2(6), 2021.
"""
