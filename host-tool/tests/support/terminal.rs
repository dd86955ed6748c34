//! A pseudo-terminal with a program in it. Shows its screen, and whether the program restores it.
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use rustix::io::{FdFlags, fcntl_setfd};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Termios, Winsize, tcgetattr, tcsetwinsize};

use crate::support::signal::{Signal, kill};

/// Time after which even a slow computer has shown it.
const SOON: Duration = Duration::from_secs(60);

/// Time that a program's last output may take to the screen after its end.
const ON_ITS_WAY: Duration = Duration::from_secs(5);

/// End of the answer to an Enter that came too soon.
const AGAIN: &str = "Press it again.";

/// Ways to end a program in a terminal.
#[derive(Clone, Copy, Debug)]
pub enum End {
    Key(&'static str),
    Signal(Signal),
}

/// A terminal with a program in it.
pub struct Terminal {
    master: File,
    slave: File,
    pub screen: Arc<Mutex<vt100::Parser>>,
    /// All bytes that the program has written.
    pub bytes: Arc<Mutex<Vec<u8>>>,
    before: Termios,
    /// Times that Enter was pressed again.
    pressed_again: usize,
    pub child: Child,
}

impl Terminal {
    pub fn start(mut command: Command, columns: u16, rows: u16) -> Self {
        let (master, slave) = open();
        let screen = Arc::new(Mutex::new(vt100::Parser::new(rows, columns, 0)));
        let bytes = Arc::new(Mutex::new(vec![]));
        let before = tcgetattr(&slave).expect("a terminal");
        let (shown, kept) = (Arc::clone(&screen), Arc::clone(&bytes));
        let mut reader = master.try_clone().expect("one more");
        thread::spawn(move || {
            let mut block = [0; 4_096];
            while let Ok(count @ 1..) = reader.read(&mut block) {
                shown.lock().expect("free").process(&block[..count]);
                kept.lock().expect("free").extend(&block[..count]);
            }
        });
        resize(master.as_fd(), columns, rows);
        let child = in_session(&mut command, &slave);
        Self {
            master,
            slave,
            screen,
            bytes,
            before,
            pressed_again: 0,
            child,
        }
    }

    /// Starts a program in a terminal that then disappears, like a closed window.
    pub fn lost(mut command: Command) -> Child {
        let (mut master, slave) = open();
        resize(master.as_fd(), 80, 24);
        let child = in_session(&mut command, &slave);
        // Close the command's handles of the terminal, too.
        drop((command, slave));
        let written = master.read(&mut [0; 100]).expect("something");
        assert!(written > 0);
        // By then the program waits for keys.
        thread::sleep(Duration::from_secs(1));
        child
    }

    pub fn text(&self) -> String {
        self.screen.lock().expect("free").screen().contents()
    }

    pub fn wait_for(&mut self, text: &str) -> String {
        let begin = Instant::now();
        let mut last = None;
        loop {
            let shown = self.text();
            if shown.contains(text) {
                if AGAIN.starts_with(text) {
                    // The test presses it.
                    self.pressed_again = self.asked_again();
                }
                return shown;
            }
            self.press_again_if_asked();
            let ended = self.child.try_wait().expect("a child");
            if ended.is_some() {
                last.get_or_insert_with(Instant::now);
            }
            assert!(
                begin.elapsed() < SOON && last.is_none_or(|last| last.elapsed() < ON_ITS_WAY),
                "no `{text}`, {ended:?}:\n{shown}\nof {:?}",
                String::from_utf8_lossy(&self.bytes.lock().expect("free"))
            );
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits until this row, counted from 0, contains this text.
    pub fn wait_for_row(&mut self, row: usize, text: &str) {
        let begin = Instant::now();
        loop {
            let parser = self.screen.lock().expect("free");
            let width = parser.screen().size().1;
            let shown = parser.screen().rows(0, width).nth(row);
            drop(parser);
            if shown.is_some_and(|shown| shown.contains(text)) {
                return;
            }
            assert!(begin.elapsed() < SOON, "no `{text}`:\n{}", self.text());
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// Ends the program.
    pub fn end_by(&self, end: End) {
        match end {
            End::Key(key) => self.press(key),
            End::Signal(signal) => kill(signal, self.child.id()),
        }
    }

    /// Presses keys as a person does, who reads a question before the Enter that answers it.
    pub fn press(&self, key: &str) {
        if key == "\n" {
            thread::sleep(Duration::from_millis(1_200));
        }
        self.press_at_once(key);
    }

    /// Presses Enter again where the program asks for it: on a busy computer its question may appear long before the
    /// program is ready for the answer.
    fn press_again_if_asked(&mut self) {
        let asked = self.asked_again();
        if asked > self.pressed_again {
            self.pressed_again = asked;
            self.press("\n");
        }
    }

    fn asked_again(&self) -> usize {
        let bytes = self.bytes.lock().expect("free");
        let parts = bytes.windows(AGAIN.len());
        parts.filter(|part| *part == AGAIN.as_bytes()).count()
    }

    fn press_at_once(&self, key: &str) {
        let mut keys = &self.master;
        keys.write_all(key.as_bytes()).expect("typed");
    }

    pub fn resize(&self, columns: u16, rows: u16) {
        let mut screen = self.screen.lock().expect("free");
        screen.screen_mut().set_size(rows, columns);
        drop(screen);
        resize(self.master.as_fd(), columns, rows);
    }

    /// Waits for the end and asserts that the terminal is restored.
    pub fn ends_restored(mut self) -> Option<i32> {
        let begin = Instant::now();
        let status = loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                break status;
            }
            self.press_again_if_asked();
            assert!(begin.elapsed() < SOON, "does not end:\n{}", self.text());
            thread::sleep(Duration::from_millis(5));
        };
        self.read_to_the_end();
        let after = tcgetattr(&self.slave).expect("a terminal");
        let modes = |termios: &Termios| {
            let Termios {
                input_modes,
                output_modes,
                control_modes,
                local_modes,
                ..
            } = termios;
            (*input_modes, *output_modes, *control_modes, *local_modes)
        };
        assert_eq!(modes(&after), modes(&self.before));
        assert!(self.is_as_before(), "{}", self.text());
        status.code()
    }

    /// Waits until all output of the program has been read: a terminal keeps the order, so a mark arrives last.
    fn read_to_the_end(&self) {
        const MARK: &[u8] = b"\x1b]2;end\x07";
        (&self.slave).write_all(MARK).expect("a terminal");
        let begin = Instant::now();
        loop {
            let mut bytes = self.bytes.lock().expect("free");
            // The echo of a key may come behind it.
            if let Some(at) = bytes.windows(MARK.len()).position(|part| part == MARK) {
                bytes.drain(at..at + MARK.len());
                return;
            }
            drop(bytes);
            assert!(begin.elapsed() < SOON, "the terminal is not read");
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// The normal screen is shown, with its cursor and colours.
    fn is_as_before(&self) -> bool {
        let screen = self.screen.lock().expect("free");
        let screen = screen.screen();
        let attributes = (screen.fgcolor(), screen.bold(), screen.inverse());
        !screen.alternate_screen()
            && !screen.hide_cursor()
            && attributes == (vt100::Color::Default, false, false)
    }
}

fn resize(terminal: std::os::fd::BorrowedFd<'_>, columns: u16, rows: u16) {
    let size = Winsize {
        ws_row: rows,
        ws_col: columns,
        ws_xpixel: 0,
        ws_ypixel: 0,
    };
    tcsetwinsize(terminal, size).expect("set");
}

/// Opens a new terminal and returns both ends.
fn open() -> (File, File) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a terminal");
    // A program that held both ends would never see the other one close.
    fcntl_setfd(&master, FdFlags::CLOEXEC).expect("set");
    grantpt(&master).expect("mine");
    unlockpt(&master).expect("mine");
    let name = ptsname(&master, vec![]).expect("named");
    let name = name.into_string().expect("UTF-8");
    let slave = File::options().read(true).write(true).open(name);
    (File::from(master), slave.expect("a terminal"))
}

/// Starts the program in the foreground, with this as its controlling terminal.
fn in_session(command: &mut Command, slave: &File) -> Child {
    let end = || Stdio::from(slave.try_clone().expect("one more"));
    command
        .stdin(end())
        .stdout(end())
        .stderr(end())
        .env("TERM", "xterm")
        .env("LC_ALL", "C.UTF-8");
    let in_session = || {
        rustix::process::setsid()?;
        rustix::process::ioctl_tiocsctty(rustix::stdio::stdin())?;
        Ok(())
    };
    // SAFETY: between fork and exec it makes two system calls and nothing else.
    unsafe { command.pre_exec(in_session) };
    command.spawn().expect("starts")
}
