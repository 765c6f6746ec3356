/* What FMPy looks up in every FMU of FMI 2.0, for FMUs that have nothing to say there: Error. */

#pragma once

const char *fmi2GetVersion(void) {
    return "2.0";
}

const char *fmi2GetTypesPlatform(void) {
    return "default";
}

#define STUB(name)                                                                                 \
    int fmi2##name(void) {                                                                         \
        return 3;                                                                                  \
    }

STUB(SetDebugLogging)
STUB(GetInteger)
STUB(GetBoolean)
STUB(GetString)
STUB(SetInteger)
STUB(SetBoolean)
STUB(SetString)
#ifndef OWN_SERIALIZATION
STUB(SerializedFMUstateSize)
STUB(SerializeFMUstate)
STUB(DeSerializeFMUstate)
#endif
STUB(GetDirectionalDerivative)
STUB(SetRealInputDerivatives)
STUB(GetRealOutputDerivatives)
STUB(CancelStep)
STUB(GetStatus)
STUB(GetRealStatus)
STUB(GetIntegerStatus)
STUB(GetBooleanStatus)
STUB(GetStringStatus)
