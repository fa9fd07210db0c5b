//! What the generator writes is what `man` and the shells accept.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use tempfile::TempDir;

fn written() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    for _ in 0..2 {
        let output = Command::new(env!("CARGO_BIN_EXE_grnet-manual")).arg(folder.path()).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    folder
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

/// Runs a checker on `file`; it must succeed and say nothing on standard error.
fn accepts(checker: &[&str], file: &Path) -> String {
    let output = Command::new(checker[0]).args(&checker[1..]).arg(file).output();
    let output = output.unwrap_or_else(|error| {
        panic!("{}: {error}; `scripts/install-packages test` installs it", checker[0])
    });
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && stderr.is_empty(), "{checker:?} {}: {stderr}", file.display());
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn every_subcommand_has_a_page_that_man_accepts() {
    let folder = written();
    let pages = files(&folder.path().join("man"));
    let names: Vec<&str> = pages.iter().map(|page| page.file_name().unwrap().to_str().unwrap()).collect();
    for expected in [
        "grnetd.8",
        "grnetd-run.8",
        "grnetd-check.8",
        "grnetd-devices.8",
        "grnetd.toml.5",
        "grnet-client.1",
        "grnet-client-tail.1",
        "grnet-client-status.1",
        "grnet-client-control.1",
        "grnet-client-control-set-pose.1",
        "grnet-train.1",
        "grnet-train-evaluate.1",
    ] {
        assert!(names.contains(&expected), "{expected} is not among {names:?}");
    }
    for page in &pages {
        let text = accepts(&["groff", "-man", "-ww", "-Tutf8", "-P-cbou"], page);
        for heading in ["NAME", "SYNOPSIS", "DESCRIPTION", "SEE ALSO"] {
            assert!(text.contains(heading), "{} has no {heading}:\n{text}", page.display());
        }
    }
    let client = accepts(&["groff", "-man", "-Tutf8", "-P-cbou"], &folder.path().join("man/grnet-client.1"));
    assert!(client.contains("EXIT STATUS") && client.contains("77 no permission"), "{client}");
}

#[test]
fn the_shells_accept_their_completions() {
    let folder = written();
    let completions = folder.path().join("completions");
    for (shell, checker) in [
        ("bash", &["bash", "-n"][..]),
        ("zsh", &["zsh", "--no-rcs", "-n"][..]),
        ("fish", &["fish", "--no-config", "--no-execute"][..]),
    ] {
        let scripts = files(&completions.join(shell));
        assert_eq!(scripts.len(), 3, "{scripts:?}");
        for script in scripts {
            accepts(checker, &script);
        }
    }
}

/// As a shell does it: what follows `grnet-client st`?
#[test]
fn bash_completes_a_subcommand() {
    let folder = written();
    let script = folder.path().join("completions/bash/grnet-client");
    let ask = r#"
        source "$0"
        set -- $(complete -p grnet-client)
        while [ "$1" != -F ]; do shift; done
        COMP_WORDS=(grnet-client st); COMP_CWORD=1
        "$2" grnet-client st grnet-client
        printf '%s\n' "${COMPREPLY[@]}""#;
    let said = accepts(&["bash", "-c", ask], &script);
    assert_eq!(said.trim(), "status");
}
