/* The table of functions for a version of FMI and an interface. */

#include "fmi/fmi.h"

const Fmi *fmi_table(int64_t version, int64_t manner) {
    static const Fmi *const tables[NUMBER_OF_MANNERS][3] = {
        [CO_SIMULATION_ALONE] = {&fmi1, &fmi2, &fmi3},
        [MODEL_EXCHANGE_SOLVED] = {&exchange1, &exchange2, &exchange3},
        [CO_SIMULATION_WITH_EVENTS] = {NULL, NULL, &events3},
    };
    const bool sound = version >= 1 && version <= 3 && manner >= 0 &&
                       manner < NUMBER_OF_MANNERS;

    if (version == 0 && manner == CO_SIMULATION_ALONE) {
        return &composite;
    }
    return sound ? tables[manner][version - 1] : NULL;
}
