#include "fmi.h"

const Fmi *fmi_table(int64_t version, bool exchange) {
    static const Fmi *const versions[2][3] = {{&fmi1, &fmi2, &fmi3},
                                              {&exchange1, &exchange2, &exchange3}};
    if (version == 0 && !exchange) {
        return &composite;
    }
    return version < 1 || version > 3 ? NULL : versions[exchange][version - 1];
}
