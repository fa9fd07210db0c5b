//! `grnet-manual DIR`: the man pages and shell completions of grnet's programs, from the command lines that the
//! programs parse and the commented configuration that the tests hold to the defaults.
//!
//! A program of its own, so that what robots run carries no generators. `make man` runs it:
//!
//! ```text
//! DIR/man/grnetd.8  grnetd-run.8 ...  grnet-client.1 ...  grnet-train.1 ...  grnetd.toml.5
//! DIR/completions/bash/grnetd ...  zsh/_grnetd ...  fish/grnetd.fish ...
//! ```
#![forbid(unsafe_code)]

mod command_page;
mod config_page;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Parser;
use clap_complete::aot::{Bash, Fish, Generator, Zsh};
use clap_complete::generate;

/// Write the man pages and shell completions of grnet's programs.
#[derive(Debug, Parser)]
#[command(name = "grnet-manual", version)]
struct Cli {
    /// Folder that gets `man` and `completions`; what they held before is replaced.
    #[arg(value_name = "DIR")]
    out: PathBuf,
}

/// A program with where its pages belong.
struct Program {
    command: clap::Command,
    section: &'static str,
    see_also: &'static [&'static str],
}

fn programs() -> [Program; 3] {
    [
        Program {
            command: grnetd::cli::command(),
            section: "8",
            see_also: &["grnetd.toml(5)", "grnet-client(1)", "grnet-train(1)"],
        },
        Program {
            command: grnet_client::cli::command(),
            section: "1",
            see_also: &["grnetd(8)", "grnetd.toml(5)"],
        },
        Program { command: grnet_train::cli::command(), section: "1", see_also: &["grnetd(8)"] },
    ]
}

fn main() -> anyhow::Result<()> {
    let Cli { out } = Cli::parse();
    let (man, completions) = (out.join("man"), out.join("completions"));
    for folder in [&man, &completions] {
        if folder.exists() {
            fs::remove_dir_all(folder).with_context(|| format!("cannot empty {}", folder.display()))?;
        }
    }
    for program in programs() {
        for (name, page) in command_page::pages(&program.command, program.section, program.see_also)? {
            write(&man, &name, &page)?;
        }
        complete(&completions, &program.command)?;
    }
    write(&man, "grnetd.toml.5", config_page::page().as_bytes())?;
    println!("man pages and completions are in {}", out.display());
    Ok(())
}

/// The completions, under the names that each shell looks for.
fn complete(folder: &Path, command: &clap::Command) -> anyhow::Result<()> {
    let name = command.get_name().to_owned();
    let script = |generator: fn(&mut clap::Command, &str, &mut Vec<u8>)| {
        let mut text = Vec::new();
        generator(&mut command.clone(), &name, &mut text);
        text
    };
    write(&folder.join("bash"), &name, &script(|c, n, out| generate(Bash, c, n, out)))?;
    write(&folder.join("zsh"), &Zsh.file_name(&name), &script(|c, n, out| generate(Zsh, c, n, out)))?;
    write(&folder.join("fish"), &Fish.file_name(&name), &script(|c, n, out| generate(Fish, c, n, out)))
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
    let path = folder.join(name);
    fs::create_dir_all(folder)
        .and_then(|()| fs::write(&path, bytes))
        .with_context(|| format!("cannot write {}", path.display()))
}
