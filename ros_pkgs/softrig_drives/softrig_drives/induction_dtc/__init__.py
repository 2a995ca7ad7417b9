"""Direct torque control of an induction motor behind quantised, dithered current converters.

Source: Ghasemian, Taheri, "Quantization Noise Reduction Using Random Dither in Direct Torque Control of an
Induction Motor". The voltage-model flux estimator of DTC integrates every mean error of the current converters:
rounding converters hardly disturb it, truncating ones let the true flux circle drift away, and one random bit added
to a truncating converter's output takes the mean away again.

The paper publishes no parameter values; the machine is the 2.2 kW motor of the examples of motulator.
"""
