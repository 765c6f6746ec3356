/* Notes crashes inside FMUs in the marks of their pools. */

#ifndef FMUGYM_CRASH_H
#define FMUGYM_CRASH_H

/* Installs the handler, unless it is there. It passes each signal on to the handler that was there
 * before. Only on Linux. */
void crash_watch(void);

#endif
