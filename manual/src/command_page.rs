//! One man page for a program and one for each of its subcommands.

use std::io;

use clap_mangen::Man;
use roff::{Roff, roman};

/// What a page about exit codes begins with in the help; in a page its heading says so.
const EXIT_CODES: &str = "Exit codes: ";

/// File names and pages of `command` and everything below it.
///
/// # Errors
/// None that a buffer in memory gives.
pub fn pages(
    command: &clap::Command,
    section: &str,
    see_also: &[&str],
) -> io::Result<Vec<(String, Vec<u8>)>> {
    let mut built = command.clone().disable_help_subcommand(true);
    built.build();
    let version = format!("grnet {}", built.get_version().unwrap_or_default());
    let mut all = Vec::new();
    add(&built, None, &Volume { section, version: &version, see_also }, &mut all)?;
    Ok(all)
}

/// What all pages of a program share.
struct Volume<'a> {
    section: &'a str,
    version: &'a str,
    see_also: &'a [&'a str],
}

fn add(
    command: &clap::Command,
    parent: Option<&str>,
    volume: &Volume<'_>,
    all: &mut Vec<(String, Vec<u8>)>,
) -> io::Result<()> {
    let Volume { section, version, see_also } = volume;
    let man = Man::new(command.clone()).section(*section).source(*version).manual("grnet");
    let mut page = Vec::new();
    man.render_title(&mut page)?;
    man.render_name_section(&mut page)?;
    man.render_synopsis_section(&mut page)?;
    man.render_description_section(&mut page)?;
    if command.get_arguments().any(|argument| !argument.is_hide_set()) {
        man.render_options_section(&mut page)?;
    }
    if command.get_subcommands().any(|below| !below.is_hide_set()) {
        man.render_subcommands_section(&mut page)?;
    }
    if let Some(codes) = command.get_after_help() {
        let codes = codes.to_string().replace('\n', " ");
        section_of(&mut page, "EXIT STATUS", codes.strip_prefix(EXIT_CODES).unwrap_or(&codes))?;
    }
    let name = command.get_display_name().unwrap_or_else(|| command.get_name());
    let parent = parent.map(|name| format!("{name}({section})"));
    let others: Vec<&str> = parent.iter().map(String::as_str).chain(see_also.iter().copied()).collect();
    section_of(&mut page, "SEE ALSO", &others.join(", "))?;
    all.push((man.get_filename(), page));
    for below in command.get_subcommands().filter(|below| !below.is_hide_set()) {
        add(below, Some(name), volume, all)?;
    }
    Ok(())
}

fn section_of(page: &mut Vec<u8>, heading: &str, text: &str) -> io::Result<()> {
    let mut roff = Roff::default();
    roff.control("SH", [heading]).text([roman(text)]);
    roff.to_writer(page)
}
