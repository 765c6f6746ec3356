/* Messages to the importer. */

#ifndef LOG_H
#define LOG_H

#include "types.h"

/* Provided by the functions of the FMI version: calls the importer's logger. */
void emit_message(const Instance *instance, Status status, const char *category,
                  const char *message);

/* Sends a message in the category of the status, and returns the status. */
RARE Status report(const Instance *instance, Status status, const char *function, const char *format,
              ...);

/* Switches log categories on or off; all of them if the list is empty. */
Status set_logging(Instance *instance, const char *function, bool on, size_t number,
                   const char *const categories[]);

/* Refuses a function whose capability the model description does not declare. */
Status not_supported(const Instance *instance, const char *function);

/* Refuses a question about a status that does not exist. */
Status no_such_status(const Instance *instance, const char *function);

#endif
