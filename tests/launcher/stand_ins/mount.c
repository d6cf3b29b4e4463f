/* Debian's minimal roots have no mount command; in C, because a start of the launcher calls it fifteen times */
#include <stdio.h>
#include <string.h>
#include <sys/mount.h>
int main(int number, char **words) {
    if (!strcmp(words[1], "-t")) return mount("tmpfs", words[6], "tmpfs", 0, words[4]);
    unsigned long flags = !strcmp(words[1], "--bind") ? MS_BIND : MS_BIND | MS_REC;
    if (!strcmp(words[1], "-o")) flags = MS_REMOUNT | MS_BIND | MS_RDONLY;
    if (mount(words[2], words[3], NULL, flags, NULL)) { perror(words[number - 1]); return 1; }
    return 0;
}
