/* Functions that every FMU of FMI 3.0 exports, and that these models have no use for: each is an error. */
#define NONE(NAME) int fmi3##NAME(void) { return 3; }
NONE(ActivateModelPartition) NONE(EnterConfigurationMode) NONE(EvaluateDiscreteStates) NONE(ExitConfigurationMode)
NONE(GetAdjointDerivative) NONE(GetBinary) NONE(GetClock) NONE(GetDirectionalDerivative) NONE(GetInt16) NONE(GetInt8)
NONE(GetIntervalDecimal) NONE(GetIntervalFraction) NONE(GetNominalsOfContinuousStates)
NONE(GetNumberOfVariableDependencies) NONE(GetOutputDerivatives) NONE(GetShiftDecimal) NONE(GetShiftFraction)
NONE(GetString) NONE(GetUInt16) NONE(GetUInt32) NONE(GetUInt64) NONE(GetVariableDependencies)
NONE(InstantiateScheduledExecution) NONE(SetBinary) NONE(SetClock) NONE(SetDebugLogging) NONE(SetInt16) NONE(SetInt8)
NONE(SetIntervalDecimal) NONE(SetIntervalFraction) NONE(SetShiftDecimal) NONE(SetShiftFraction) NONE(SetString)
NONE(SetUInt16) NONE(SetUInt32) NONE(SetUInt64)
