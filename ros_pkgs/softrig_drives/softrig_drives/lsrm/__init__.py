"""Four-phase double-sided linear switched reluctance motor with jerk-minimal speed profile and fuzzy speed control.

Source: Azadrou, Masoudi, Ghanizadeh, Alemi, "Improving Quality of Movement in a Linear Switched Reluctance Motor Using
a Fuzzy Logic System". A chain of three controllers: profile generator -> speed controller (fuzzy, PI or model
reference adaptive) -> force command -> commutation and four current loops -> voltages of four asymmetric half bridges.

The paper plots its finite-element inductance only; the closed form of `machine` and every chosen constant are explained
on the page of this drive in the package documentation.
"""
